"""`taisoft tetrahedralize SURFACE`: fills a surface with tets and writes a mesh file."""

from argparse import Namespace
from pathlib import Path

from taisoft.cli.info import describe
from taisoft.cli.signals import Signals
from taisoft.cli.warnings import printed_warnings
from taisoft.errors import OutputError
from taisoft.mesh.files import check_ending, write_mesh
from taisoft.mesh.surface_mesh import read_surface, tetrahedralize


def command(arguments: Namespace) -> int:
    """Write the mesh and print its properties. Bad arguments are refused before the mesher starts."""
    out = Path(arguments.out)
    check_ending(out)
    if out.exists() and not arguments.overwrite:
        raise OutputError(f"{out}: the file exists; --overwrite replaces it")
    if not out.parent.is_dir():
        raise OutputError(f"{out}: there is no folder {out.parent}")
    with Signals(), printed_warnings():
        surface = read_surface(arguments.surface, weld=arguments.weld)
        mesh = tetrahedralize(surface, arguments.edge_length, arguments.envelope)
        write_mesh(out, mesh)
    print(out)
    for name, text in describe(mesh):
        print(f"  {name:<10} {text}")
    return 0
