"""Messages about broken mesh files, with a narrow terminal and a long folder name:

* they start with the file's exact name and end with the reader's message, in one line, without repeating the name;
* text that a reader prints as markup is no error.
"""

import re

import meshio
import numpy as np
import pytest

import taisoft as ts
from tests.mesh.test_mesh_files import MESH, same, write_by_meshio

LONG = "a folder with a [bold]long[/bold] name " * 5  # of 195 characters; brackets are markup in rich


@pytest.fixture
def narrow(tmp_path, monkeypatch):
    """A folder whose name is longer than a line of the terminal."""
    monkeypatch.setenv("COLUMNS", "20")
    folder = tmp_path / LONG
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize(
    "name, message",
    [
        ("a b.vtk", "not a supported mesh (Illegal VTK header)"),
        ("[red]a[/blue] b.mesh", "not a supported mesh (Unknown keyword ....)"),
        (":smile: a.msh", "not a supported mesh (its structure is broken)"),
        ("a.vtu", "not a supported mesh (its structure is broken)"),
        ("a.vol", "not a supported mesh (RuntimeError: Not a valid Netgen mesh)"),
        ("a.svg", "not a supported mesh (such files can only be written: svg)"),
        ("a.mdpa", "no tetrahedra; no elements found"),
    ],
)
def test_messages_give_the_exact_name_and_one_cause(narrow, name, message):
    path = narrow / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("passphrase\nof three lines\n\n")
    with pytest.raises(ts.MeshError, match=f"^{re.escape(f'{path}: {message}')}$"):
        ts.read_mesh(path)


def test_messages_about_surfaces(narrow):
    (narrow / "a b.ply").write_text("passphrase")
    with pytest.raises(ts.MeshError, match=f"^{re.escape(f'{narrow}/a b.ply: not a supported surface (Expected ply)')}$"):
        ts.read_surface(narrow / "a b.ply")


def test_messages_about_scene_files_are_not_cut_by_a_long_folder_name(narrow):
    folder = narrow / LONG
    folder.mkdir(parents=True)
    (folder / "a b.vtk").write_text("passphrase")
    (folder / "scene.toml").write_text("[bodies.a]\nmaterial = {}\nmesh = { file = 'a b.vtk' }\n")
    with pytest.raises(ts.MeshError) as caught:
        ts.read_scene(folder / "scene.toml")
    message = "not a supported mesh (Illegal VTK header)"
    assert str(caught.value) == f"{folder}/scene.toml: bodies.a.mesh: {folder}/a b.vtk: {message}"


def test_markup_in_output_of_a_reader_is_no_error(tmp_path, capfd):
    path = write_by_meshio(tmp_path / "part.su2", [("tetra", MESH.tets)])
    path.write_text(path.read_text() + "[/red] :smile:\n")
    capfd.readouterr()
    assert same(ts.read_mesh(path)) and capfd.readouterr() == ("", "")


def test_more_data_than_the_file_can_hold(tmp_path):
    """A small compressed file that would fill the memory of its reader."""
    path = tmp_path / "zeros.vtu"
    meshio.write(path, meshio.Mesh(np.zeros((2_000_000, 3)), [("tetra", np.array([[0, 1, 2, 3]]))]), compression="zlib")
    assert path.stat().st_size < 1e6
    with pytest.raises(ts.MeshError, match="it declares more data than it can hold"):
        ts.read_mesh(path)
