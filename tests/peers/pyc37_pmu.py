"""pyc37 as a PMU: ``python pyc37_pmu.py '{"port": ..., "config": HEX, "data": [HEX...], ...}'``.

Serves the stream over TCP on loopback and gives each client all data frames once, in order, after its start command.
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
    pmu.run()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    served: list[object] = []
    while True:
        for queue in pmu.client_buffers:
            if all(queue is not known for known in served):
                served.append(queue)
                for frame in frames:
                    queue.put(frame)
        time.sleep(0.01)


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
