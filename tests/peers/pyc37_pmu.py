"""pyc37 as a PMU: ``python pyc37_pmu.py '{"port": ..., "config": HEX, "data": [HEX...], ...}'``.

Serves the stream over TCP on loopback and gives each client all data frames once, in order, after its start command;
with ``age_s`` each when it is so old by its stamp, and only those that become so while the client is there.
Prints ``ready`` when it listens. Ends itself and its client handlers after ``limit_s`` seconds, whatever happens.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import time
import types
from typing import Any


def main() -> None:
    job = json.loads(sys.argv[1])
    signal.signal(signal.SIGALRM, lambda *_: os.killpg(0, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, job["limit_s"])
    logging.disable(logging.CRITICAL)
    sys.modules.setdefault("psutil", types.ModuleType("psutil"))  # pyc37 wants it for its log lines only
    from pyc37.frame import CommonFrame, ConfigFrame1
    from pyc37.pmu import Pmu

    config = CommonFrame.convert2frame(bytes.fromhex(job["config"]))
    frames = [CommonFrame.convert2frame(bytes.fromhex(frame), config) for frame in job["data"]]
    for frame in frames:  # what pyc37 decodes as "in sync" it would encode as the opposite
        stats = frame._stat if isinstance(frame._stat, list) else [frame._stat]
        true = [stat ^ 0x2000 for stat in stats]
        frame.set_stat(true if config.is_multistreaming() else true[0])
    first = ConfigFrame1.convert2frame(bytes.fromhex(job["config"]))
    pmu = Pmu(config.get_id_code(), config.get_data_rate(), job["port"], set_timestamp=job["stamp_now"])
    pmu.set_configuration(config)
    pmu.cfg1 = first
    pmu.set_header(job["header"])
    end_on_sigterm(pmu)
    if job["age_s"] is not None:
        hurry()
    pmu.run()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    if job["age_s"] is not None:
        due_s = [stamp_s(bytes.fromhex(frame), bytes.fromhex(job["config"])) + job["age_s"] for frame in job["data"]]
        serve_in_time(pmu, frames, due_s)
    served: list[object] = []
    while True:
        for queue in pmu.client_buffers:
            if all(queue is not known for known in served):
                served.append(queue)
                for frame in frames:
                    queue.put(frame)
        time.sleep(0.01)


def stamp_s(frame: bytes, config: bytes) -> float:
    """POSIX UTC of a data frame, by the TIME_BASE of its CFG-2."""
    soc, fraction, time_base = (int.from_bytes(part) for part in (frame[6:10], frame[11:14], config[15:18]))
    return soc + fraction / time_base


def hurry() -> None:
    """Before a frame leaves, pyc37 looks 100 ms for a command and then sleeps for a frame period: here it does not."""
    module: Any = sys.modules["pyc37.pmu"]
    wait = module.select
    module.select = lambda readers, writers, errors, _: wait(readers, writers, errors, 0.002)
    module.sleep = lambda _: None


def serve_in_time(pmu: Any, frames: list[Any], due_s: list[float]) -> None:
    """Give every client that is there each frame when it is due; then wait for the end."""
    for frame, at_s in zip(frames, due_s, strict=True):
        if at_s < time.time():
            continue
        time.sleep(max(0.0, at_s - time.time()))
        for queue in list(pmu.client_buffers):
            queue.put(frame)
    signal.pause()


def end_on_sigterm(pmu: Any) -> None:
    """End the client handlers, which are processes of their own, and reap them."""
    runner = os.getpid()

    def end(*_: object) -> None:
        for client in pmu.clients if os.getpid() == runner else ():
            client.kill()
            client.join(1)
        os._exit(0)

    signal.signal(signal.SIGTERM, end)


if __name__ == "__main__":
    main()
