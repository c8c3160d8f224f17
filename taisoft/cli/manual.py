"""`taisoft docs`: open the manual, which a released wheel carries, and which `make docs` builds in a checkout."""

import webbrowser
from argparse import Namespace

from taisoft.cli import scene_file
from taisoft.errors import SceneError
from taisoft.scene.checks import nearest

FOLDER = "out/docs"  # beside the package in a checkout, inside it in a wheel


def docs(arguments: Namespace) -> int:
    """Print the path of a page, and open it where there is a browser. Raises SceneError without the manual or such a page."""
    folder = scene_file.shipped_folder(FOLDER)
    pages = (
        {} if folder is None else {path.relative_to(folder).with_suffix("").as_posix(): path for path in folder.rglob("*.html")}
    )
    if not pages:
        if (scene_file.PACKAGE.parent / "docs" / "conf.py").is_file():
            raise SceneError("the manual is not built yet: `make docs` builds it; its pages are also in docs/, as Markdown")
        raise SceneError("this taisoft was built without its manual: its pages are in docs/ of the sources, as Markdown")
    page = pages.get(arguments.page.removesuffix(".html").removesuffix(".md"))
    if page is None:
        raise SceneError(
            f"the manual has no page {arguments.page!r}{nearest(arguments.page, pages)}; `taisoft docs` opens its index"
        )
    print(page)
    if not arguments.path:
        webbrowser.open(page.as_uri())
    return 0
