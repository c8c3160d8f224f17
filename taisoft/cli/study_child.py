"""A process of a study: one line of JSON on stdin says what to do, JSON on stdout is the answer.

It leaves when stdin closes, so that it does not outlive the command, and takes its cores before NumPy and Taichi start.
What a scene prints goes to stderr.
"""

import functools
import json
import os
import sys
import threading
from collections.abc import Callable


def main() -> None:
    """Reads {"do": "plan" or "run", ...} and writes {"answer": ...} or {"error": sentence}."""
    serve(_answer)


def serve(answer: Callable[[dict], dict]) -> None:
    """Read one request, write its answer, and end the process."""
    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 65536)
        if not part:
            os._exit(1)
        line += part
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    request = json.loads(line)
    if request.get("cores") and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, request["cores"])
    out.write(_text(answer(request)))
    out.flush()
    sys.stderr.flush()
    os._exit(0)  # nothing is left to do, and taking Taichi down takes time


def _text(answer: dict) -> bytes:
    from taisoft.output.report import json_text

    return json_text(answer).encode()


def _leave_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def _answer(request: dict) -> dict:
    from taisoft.checkpoint import scene_digest
    from taisoft.cli.scene_file import find_scene, load_scene
    from taisoft.cli.settings import check_scene_solver
    from taisoft.errors import TaisoftError
    from taisoft.study.grid import mesh_name
    from taisoft.study.measure import measure
    from taisoft.study.plan import make_plan
    from taisoft.study.store import code_digest, digests, sources

    scenes: dict[str, str] = {}  # digest of each variant that was loaded
    load = functools.partial(load_scene, request["scene"], request["allow_outside"])

    def variant(refine, order):
        scene = load(refine, order)[0]
        scenes[mesh_name({"refine": refine, "order": order})] = scene_digest(scene)
        return scene

    try:
        if request["do"] == "plan":
            _, solver = load(0)
            check_scene_solver(solver)
            made = make_plan(variant, solver, request["request"])
            # with the files' content, too: paths that are functions are told apart by nothing else
            own = sources(find_scene(request["scene"]))
            return {"answer": made | {"scenes": scenes, "sources": own, "code": code_digest()}}
        if code_digest() != request["code"]:
            return {"error": "taisoft, Taichi or NumPy there is not the one that planned the study"}
        task = request["task"]
        scene = variant(task["setting"]["refine"], task["setting"]["order"])
        told = digests(find_scene(request["scene"]), request["sources"])
        if scenes != {mesh_name(task["setting"]): request["digest"]} or told != request["sources"]:
            return {"error": "the scene there is not the one that was planned: it was changed meanwhile, or is another file"}
        return {"answer": measure(scene, task)}
    except TaisoftError as error:
        return {"error": str(error)}


if __name__ == "__main__":
    main()
