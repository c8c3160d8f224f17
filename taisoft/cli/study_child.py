"""Child process of a study: reads a request as one line of JSON on stdin and writes its answer as JSON on stdout.

It exits when stdin closes, so that it does not outlive the command, and is pinned to its cores before NumPy and Taichi start.
Output of a scene goes to stderr.
"""

import functools
import json
import os
import sys
import threading
from collections.abc import Callable


def main() -> None:
    """Read {"do": "plan" or "run", ...} and write {"answer": ...} or {"error": sentence}."""
    serve(_answer)


def serve(answer: Callable[[dict], dict]) -> None:
    """Read one request, write its answer, and end the process."""
    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 65536)
        if not part:
            os._exit(1)
        line += part
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    request = json.loads(line)
    if request.get("cores") and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, request["cores"])
    out.write(_text(answer(request)))
    out.flush()
    sys.stderr.flush()
    os._exit(0)  # skips Taichi's slow shutdown


def _text(answer: dict) -> bytes:
    from taisoft.output.report import json_text

    return json_text(answer).encode()


def _exit_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def _answer(request: dict) -> dict:
    from taisoft.cli.scene_file import find_scene, load_scene
    from taisoft.cli.settings import check_scene_solver
    from taisoft.errors import TaisoftError
    from taisoft.scene.fingerprint import scene_digest
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
            plan = make_plan(variant, solver, request["request"])
            # include the files' content: nothing else distinguishes paths that are functions
            own = sources(find_scene(request["scene"]))
            return {"answer": plan | {"scenes": scenes, "sources": own, "code": code_digest()}}
        if code_digest() != request["code"]:
            return {"error": "taisoft, Taichi or NumPy there differs from the one that planned the study"}
        task = request["task"]
        scene = variant(task["setting"]["refine"], task["setting"]["order"])
        found = digests(find_scene(request["scene"]), request["sources"])
        if scenes != {mesh_name(task["setting"]): request["digest"]} or found != request["sources"]:
            return {"error": "the scene there differs from the planned one: it was changed meanwhile, or is another file"}
        return {"answer": measure(scene, task)}
    except TaisoftError as error:
        return {"error": str(error)}


if __name__ == "__main__":
    main()
