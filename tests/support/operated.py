"""A platform without control: its operators' link verifies orders, and ticks tell what became of them."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

from support.shipped import FakeControl

from dcon.core.values import Event, Order
from dcon.link import paths
from dcon.link.keys import read_keys
from dcon.link.orders import RefusalLog, Refused, Verifier
from dcon.link.paths import bind_datagram


class FakePlatform:
    """Runs in a thread at 200 ticks/s. ``activate`` is refused, everything else is obeyed; ``deaf`` hears nothing, and
    while ``hangs`` is set there are no ticks, and all sockets stay open."""

    def __init__(self, folder: Path, keys: Path, deaf: bool = False) -> None:
        self.control = FakeControl(folder)
        self.control.begun_ns = time.time_ns()
        self.aide = bind_datagram(folder, paths.AIDE)
        self.deaf = deaf
        self.hangs = threading.Event()
        self.verifier = Verifier(read_keys(keys))
        self.refusals = RefusalLog()
        self.taken: list[Order] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.control.shipping.close()
        paths.release(self.aide)

    def _run(self) -> None:
        while not self._ended.is_set():
            if self.hangs.is_set():
                time.sleep(0.005)
                continue
            orders = [] if self.deaf else self._heard()
            events = [
                Event("refused", order.name, f"not possible in STANDBY; order by {order.who}")
                if order.name == "activate"
                else Event("done", "system", f"order by {order.who}")
                for order in orders
                if order.name != "link_refused"
            ]
            self.taken += orders
            self.control.tick(tuple(orders), tuple(events))
            time.sleep(0.005)

    def _heard(self) -> list[Order]:
        orders = []
        while True:
            try:
                said = json.loads(self.aide.recv(1 << 16))
            except BlockingIOError:
                return orders
            assert said["kind"] == "signed"
            signed = bytes.fromhex(said["order"])
            now_ns = time.time_ns()
            found = self.verifier.verify(signed, now_ns)
            order = self.refusals.order(found, signed, now_ns) if isinstance(found, Refused) else found.order
            if order is not None:
                orders.append(order)
