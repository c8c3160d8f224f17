"""A study on a Dask cluster of two worker processes on loopback addresses of this machine:

* workers run in separate processes on separate cores;
* the run of a lost worker moves to another one; runs end with the study.
"""

import os
import re
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest

from tests.cli.command import ROOT, write
from tests.study.study_places import wait_until_ended

pytest.importorskip("distributed")

from taisoft.machine import usable_cores
from taisoft.study.workers import BUDGET_SPENT, CUT_BY_BUDGET, carry_out, cluster_places, connect

SLOW = "import os, time\n\n\ndef build():\n    open({file!r}, 'a').write(f'{{os.getpid()}}\\n')\n    time.sleep(300)\n"


def dask(stack: ExitStack, *arguments) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__DIAGNOSTICS__NVML": "False"}
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *map(str, arguments[1:])],
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process


@pytest.mark.long
@pytest.mark.skipif(len(usable_cores()) < 2, reason="two workers need a core each")
def test_workers_use_separate_cores_and_may_be_lost(tmp_path):
    pids, common = tmp_path / "pids", ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", tmp_path)
    path = write(tmp_path / "slow.py", SLOW.format(file=str(pids)))
    request = {"action": "plan", "scene": str(path), "allow_outside": False, "request": {}}
    with ExitStack() as stack:
        scheduler = dask(stack, "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show")
        address = next(m[1] for line in scheduler.stderr if (m := re.search(r"(tcp://127\.0\.0\.1:\d+)", line)))
        processes = [dask(stack, "dask_worker", address, *common, "--host", "127.0.0.1") for _ in range(2)]
        client = stack.enter_context(connect(address))
        client.wait_for_workers(2, timeout=60)
        places, machines = cluster_places(client)
        assert len(places) == 2 and len(machines) == 1
        assert len(set(places[0].cores) | set(places[1].cores)) == len(places[0].cores) + len(places[1].cores)

        def started() -> list[int]:
            return [int(line) for line in pids.read_text().split()] if pids.exists() else []

        pids_at_kill: list[int] = []
        deadline = time.monotonic() + 120

        def stop_requested() -> bool:
            """Kill a worker once both runs have started; its run then waits for the other worker, which is busy."""
            nonlocal deadline
            if len(started()) == 2 and not pids_at_kill:
                pids_at_kill.extend(started())
                processes[0].kill()
                deadline = time.monotonic() + 15
            return False

        unfinished = carry_out(
            [("a", request), ("b", request)],
            places,
            lambda key, answer: None,
            stop_requested=stop_requested,
            seconds_left=lambda: deadline - time.monotonic(),
        )
        assert sorted(unfinished.values()) == [BUDGET_SPENT, CUT_BY_BUDGET] and len(pids_at_kill) == 2
    wait_until_ended(started())
