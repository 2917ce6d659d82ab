import dataclasses
import struct
import zipfile

import numpy as np
import pytest
import trimesh
from known_meshes import cube, flatten, joined, sheet, torus

from mn_onnx.extract.files import WRITABLE, MeshFileError, check_mesh_options, read_mesh, write_mesh
from mn_onnx.extract.files import text as text_module
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.surface import Surface

POLYGONS = (".ply", ".obj", ".off")
TRIANGLES = (".stl", ".glb", ".3mf")


def mixed_polygons():
    """A prism over a heptagon: quads and two heptagons, with coordinates that float32 cannot hold."""
    angle = 2 * np.pi * np.arange(7) / 7
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) / 3
    quads = [[i, (i + 1) % 7, 7 + (i + 1) % 7, 7 + i] for i in range(7)]
    surface = Surface.from_polygons(
        np.concatenate([rim, rim + np.array([0, 0, 1 / 3])]),
        *flatten([*quads, list(range(7))[::-1], list(range(7, 14))]),
    )
    return dataclasses.replace(
        surface,
        errors=np.arange(9) / 7,
        attributes={"layer": np.arange(9), "sharp": np.arange(9) % 2 == 0, "colour": np.arange(27.0).reshape(9, 3)},
    )


@pytest.mark.parametrize("extension", POLYGONS)
def test_polygons_come_back_as_they_were(tmp_path, extension):
    surface = mixed_polygons()
    for float64 in (False, True):
        write_mesh(surface, tmp_path / f"mesh{extension}", float64=float64)
        back = read_mesh(tmp_path / f"mesh{extension}")
        np.testing.assert_array_equal(back.offsets, surface.offsets)
        np.testing.assert_array_equal(back.corners, surface.corners)
        np.testing.assert_array_equal(back.twins, surface.twins)
        expected = surface.vertices if float64 else surface.vertices.astype(np.float32)
        np.testing.assert_array_equal(back.vertices if float64 else back.vertices.astype(np.float32), expected)


@pytest.mark.parametrize("extension", TRIANGLES)
def test_triangles_close_again(tmp_path, extension):
    write_mesh(joined(mixed_polygons(), torus(), cube(0.2)), tmp_path / f"mesh{extension}")
    found = check_invariants(read_mesh(tmp_path / f"mesh{extension}"))
    assert found.problems() == []
    assert [component.euler for component in found.components] == [2, 0, 2]
    assert found.polygons == 7 * 2 + 2 * 5 + 2 * 24 * 12 + 12
    assert found.volume == pytest.approx(mixed_polygons().volume + torus().volume + 0.2**3, rel=0.03)


@pytest.mark.parametrize("extension", [".ply", ".obj", ".off", ".stl", ".glb"])
def test_trimesh_reads_what_we_write(tmp_path, extension):
    write_mesh(torus(), tmp_path / f"mesh{extension}", triangulate=True)
    mesh = trimesh.load_mesh(tmp_path / f"mesh{extension}")
    assert mesh.is_watertight
    assert mesh.euler_number == 0
    assert mesh.volume == pytest.approx(torus().to_trimesh().volume, rel=1e-5)


def test_ply_carries_values_per_face(tmp_path):
    surface = mixed_polygons()
    names = ["normals", "errors", "layer", "sharp", "colour"]
    write_mesh(surface, tmp_path / "mesh.ply", float64=True, attributes=names)
    content = (tmp_path / "mesh.ply").read_bytes()
    header, _, body = content.partition(b"end_header\n")
    assert b"property double nx\nproperty double ny\nproperty double nz\nproperty double errors\n" in header
    assert b"property int layer\nproperty uchar sharp\nproperty double colour_0\n" in header
    at = 14 * 3 * 8
    for polygon in range(9):
        n = body[at]
        corners = struct.unpack_from(f"<{n}i", body, at + 1)
        values = struct.unpack_from("<3ddiB3d", body, at + 1 + 4 * n)
        at += 1 + 4 * n + struct.calcsize("<3ddiB3d")
        begin, end = surface.offsets[polygon : polygon + 2]
        assert corners == tuple(surface.corners[begin:end])
        assert values[:3] == tuple(surface.normals[polygon])
        assert values[3:6] == (surface.errors[polygon], polygon, polygon % 2 == 0)
        assert values[6:] == tuple(surface.attributes["colour"][polygon])
    assert at == len(body)
    assert read_mesh(tmp_path / "mesh.ply").n_polygons == 9


def test_triangulated_values_follow_their_polygon(tmp_path):
    surface = mixed_polygons()
    write_mesh(surface, tmp_path / "mesh.ply", triangulate=True, attributes=["layer"])
    body = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header\n")[2]
    rows = np.frombuffer(body[14 * 3 * 4 :], np.dtype([("n", "u1"), ("corners", "<i4", 3), ("layer", "<i4")]))
    np.testing.assert_array_equal(rows["layer"], surface.triangle_polygons())
    np.testing.assert_array_equal(rows["corners"], surface.triangles())


def test_polygons_of_more_than_255_corners(tmp_path):
    n = 300
    angle = 2 * np.pi * np.arange(n) / n
    disc = Surface.from_polygons(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), [0, n], np.arange(n))
    write_mesh(disc, tmp_path / "disc.ply", attributes=["normals"])
    assert b"property list int int" in (tmp_path / "disc.ply").read_bytes()
    np.testing.assert_array_equal(read_mesh(tmp_path / "disc.ply").corners, np.arange(n))


@pytest.mark.parametrize("extension", WRITABLE)
def test_the_same_surface_gives_the_same_bytes(tmp_path, extension):
    for name in ("one", "two"):
        write_mesh(mixed_polygons(), tmp_path / f"{name}{extension}")
    assert (tmp_path / f"one{extension}").read_bytes() == (tmp_path / f"two{extension}").read_bytes()


@pytest.mark.parametrize("extension", POLYGONS)
def test_many_chunks_join_without_a_seam(tmp_path, extension, monkeypatch):
    write_mesh(mixed_polygons(), tmp_path / f"whole{extension}")
    monkeypatch.setattr("mn_onnx.extract.files.polygon_mesh.CHUNK", 4)
    write_mesh(mixed_polygons(), tmp_path / f"parts{extension}")
    assert (tmp_path / f"whole{extension}").read_bytes() == (tmp_path / f"parts{extension}").read_bytes()


@pytest.mark.parametrize("extension", [".ply", ".obj", ".off", ".3mf"])
def test_an_empty_surface_is_a_file_without_faces(tmp_path, extension):
    write_mesh(Surface.from_polygons(np.zeros((0, 3)), [0], np.zeros(0, int)), tmp_path / f"empty{extension}")
    assert read_mesh(tmp_path / f"empty{extension}").n_polygons == 0


def test_an_empty_stl_has_a_count_of_zero(tmp_path):
    write_mesh(Surface.from_polygons(np.zeros((0, 3)), [0], np.zeros(0, int)), tmp_path / "empty.stl")
    assert (tmp_path / "empty.stl").read_bytes()[80:] == bytes(4)


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, OSError("disk full")])
def test_nothing_is_left_of_an_interrupted_file(tmp_path, monkeypatch, interruption):
    target = tmp_path / "mesh.obj"
    target.write_text("before")

    def interrupt(*arguments):
        raise interruption

    monkeypatch.setattr(text_module, "_write_polygons", interrupt)
    with pytest.raises(interruption if isinstance(interruption, type) else OSError):
        write_mesh(cube(), target)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def test_unwritable_requests_are_refused_with_all_reasons(tmp_path):
    with pytest.raises(
        MeshFileError, match=r"ends in \.xyz; a mesh is written to \.ply, \.obj, \.off, \.stl, \.glb, \.3mf"
    ):
        write_mesh(cube(), tmp_path / "mesh.xyz")
    with pytest.raises(MeshFileError, match="has no extension"):
        check_mesh_options(tmp_path / "mesh")
    with pytest.raises(
        MeshFileError, match=r"float32 only; for float64.*no values per face; write to \.ply.*folder.*not exist"
    ):
        check_mesh_options(tmp_path / "missing" / "mesh.stl", float64=True, attributes=["normals"])
    with pytest.raises(MeshFileError, match="no attribute colour; there are normals, errors"):
        write_mesh(cube(), tmp_path / "mesh.ply", attributes=["colour"])
    huge = dataclasses.replace(cube(), attributes={"id": np.full(6, 2**40), "name": np.array(["a"] * 6)})
    with pytest.raises(MeshFileError, match="beyond 32 bits"):
        write_mesh(huge, tmp_path / "mesh.ply", attributes=["id"])
    with pytest.raises(MeshFileError, match="holds integers and floats"):
        write_mesh(huge, tmp_path / "mesh.ply", attributes=["name"])
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(MeshFileError, match="is a folder"):
        check_mesh_options(tmp_path / "folder.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ply"]


PLY_TEXT = """ply
format ascii 1.0
comment by hand
element vertex 4
property float x
property float y
property float z
property uchar red
element face 2
property uchar material
property list uchar int vertex_index
property float quality
end_header
0 0 0 1
1 0 0 2
1 1 0.5 3
0 1 0 4
7 3 0 1 2 0.5
7 3 0 2 3 0.25
"""


def test_text_ply_with_other_properties(tmp_path):
    (tmp_path / "mesh.ply").write_text(PLY_TEXT)
    surface = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(surface.corners, [0, 1, 2, 0, 2, 3])
    np.testing.assert_array_equal(surface.vertices[2], [1, 1, 0.5])


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_either_byte_order_with_other_elements(tmp_path, order):
    kind = {"<": "little", ">": "big"}[order]
    header = f"""ply
format binary_{kind}_endian 1.0
element material 1
property short kind
element vertex 5
property double x
property double y
property double z
property uchar red
element face 2
property short material
property list ushort uint vertex_indices
property float quality
end_header
"""
    body = struct.pack(f"{order}h", 5)
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0.1)]
    body += b"".join(struct.pack(f"{order}3dB", *point, 9) for point in points)
    body += struct.pack(f"{order}hH4If", 1, 4, 0, 1, 2, 3, 0.5) + struct.pack(f"{order}hH3If", 1, 3, 3, 2, 4, 0.5)
    (tmp_path / "mesh.ply").write_bytes(header.encode() + body)
    surface = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(surface.vertices, points)
    np.testing.assert_array_equal(surface.offsets, [0, 4, 7])
    np.testing.assert_array_equal(surface.corners, [0, 1, 2, 3, 3, 2, 4])
    (tmp_path / "cut.ply").write_bytes(header.encode() + body[:-5])
    with pytest.raises(MeshFileError, match="ends within its element face"):
        read_mesh(tmp_path / "cut.ply")
    (tmp_path / "shorter.ply").write_bytes(header.encode() + body[:30])
    with pytest.raises(MeshFileError, match="ends within its element vertex"):
        read_mesh(tmp_path / "shorter.ply")


def test_obj_with_normals_textures_and_relative_indices(tmp_path):
    (tmp_path / "mesh.obj").write_text(
        "# comment\nmtllib a.mtl\nv 0 0 0 1.0\nv 1 0 0\nv 1 1 0\nvn 0 0 1\nvt 0 0\n"
        "f 1/1/1 2//1 3/1\nv 0 1 0\nf -4 -2 -1\n"
    )
    surface = read_mesh(tmp_path / "mesh.obj")
    np.testing.assert_array_equal(surface.corners, [0, 1, 2, 0, 2, 3])


def test_off_with_comments_and_counts_on_the_first_line(tmp_path):
    (tmp_path / "mesh.off").write_text("OFF 3 1 0 # counts\n\n0 0 0\n1 0 0 # a vertex\n0 1 0\n3 0 1 2 255 0 0\n")
    assert read_mesh(tmp_path / "mesh.off").area == pytest.approx(0.5)


def test_stl_merges_equal_vertices_and_drops_what_collapses(tmp_path):
    corners = np.array(
        [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[-0.0, 0, 0], [0, 1, 0], [-1, 0, 0]], [[0, 0, 0]] * 3], "<f4"
    )
    rows = np.zeros(3, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    rows["corners"] = corners
    (tmp_path / "mesh.stl").write_bytes(b"by hand".ljust(80) + struct.pack("<I", 3) + rows.tobytes())
    surface = read_mesh(tmp_path / "mesh.stl")
    assert (surface.n_polygons, surface.n_vertices, surface.n_edges) == (2, 4, 5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", "plx\n", "no PLY header"),
        ("a.ply", "ply\nformat binary_middle_endian 1.0\nend_header\n", "unknown PLY format"),
        ("a.ply", "ply\nend_header\n", "names no format"),
        ("a.ply", PLY_TEXT.replace("property float quality", "property list int int more"), "two lists"),
        ("a.ply", PLY_TEXT.replace("uchar material", "half material"), "unknown PLY type half"),
        ("a.ply", PLY_TEXT.replace("float x", "float u"), "no vertices with x, y, z"),
        ("a.ply", PLY_TEXT.rpartition("7 3")[0], "ends within its element face"),
        ("a.ply", PLY_TEXT.replace("0 2 3", "0 2 4"), "holds no valid mesh.*of only 4|holds no valid mesh.*4 vertices"),
        ("a.obj", "v 0 0 0\nv 1 0\n", "holds no valid mesh"),
        ("a.obj", "v 0 0 0\nf 1 x 1\n", "line 2"),
        ("a.off", "COFF\n", "does not begin with OFF"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n", "ends after 1 of 4"),
        ("a.off", "OFF\n1 1 0\n0 0 0\n3 0 0\n", "fewer corners than they announce"),
        ("a.off", "OFF\nx\n", "not a valid OFF"),
        ("a.3mf", "PK", "not a valid 3MF"),
        ("a.step", "ISO", "unknown kind of mesh file"),
        ("a.stl", "solid nothing", "holds no triangles"),
        ("a.glb", "glTF", "cannot be read"),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(MeshFileError, match=message):
        read_mesh(tmp_path / name)


def test_a_cut_stl_is_refused(tmp_path):
    write_mesh(torus(), tmp_path / "whole.stl")
    (tmp_path / "cut.stl").write_bytes((tmp_path / "whole.stl").read_bytes()[:-30])
    with pytest.raises(MeshFileError, match="cannot be read"):
        read_mesh(tmp_path / "cut.stl")


def test_3mf_with_placed_objects_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.3mf", "w") as archive:
        archive.writestr("3D/3dmodel.model", '<model><build><item objectid="1" transform="1 0 0"/></build></model>')
    with pytest.raises(MeshFileError, match="by transforms"):
        read_mesh(tmp_path / "a.3mf")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no mesh file .*nothing\.ply"):
        read_mesh(tmp_path / "nothing.ply")


def test_open_surfaces_keep_their_boundary(tmp_path):
    write_mesh(sheet(), tmp_path / "sheet.ply")
    assert (read_mesh(tmp_path / "sheet.ply").twins < 0).sum() == 20
