"""FLAME's files, here with the embedded head's numbers in them: read to the bit, or refused."""

import pickle
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import scipy.spatial
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel, uv_anchors
from rgbavatar_ns.head.flame import FLAME_VARIABLE, load_flame
from rgbavatar_ns.head.flame_uv import make_uv_map, read_uv_map
from rgbavatar_ns.synthetic.flame import write_synthetic_flame


@pytest.fixture(scope="module")
def python_read(tmp_path_factory) -> tuple[Path, dict]:
    """The same model without chumpy, as Python's own pickle reads it."""
    path = write_synthetic_flame(tmp_path_factory.mktemp("flame"), "2023", chumpy=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return path, pickle.loads(path.read_bytes(), encoding="latin1")


def test_synthetic_file_has_flames_keys_shapes_and_types(python_read):
    model = python_read[1]
    shapes = {name: value.shape for name, value in model.items() if hasattr(value, "shape")}
    assert shapes == {
        "v_template": (5023, 3),
        "shapedirs": (5023, 3, 400),
        "posedirs": (5023, 3, 36),
        "J_regressor": (5, 5023),
        "kintree_table": (2, 5),
        "weights": (5023, 5),
        "f": (9976, 3),
        "J": (5, 3),
    }
    assert scipy.sparse.isspmatrix_csc(model["J_regressor"])
    assert model["kintree_table"].dtype == model["f"].dtype == np.uint32
    assert model["kintree_table"].tolist() == [[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]]
    assert len(np.unique(model["f"])) == 5023


def test_numbers_are_those_that_pythons_pickle_reads(python_read):
    path, model = python_read
    flame = load_flame(path, teeth=False)
    assert flame.name == "FLAME 2023"
    for ours, theirs in (
        (flame.v_template, model["v_template"]),
        (flame.shapedirs, model["shapedirs"]),
        (flame.joint_regressor, model["J_regressor"].toarray()),
        (flame.skinning_weights, model["weights"]),
        (flame.faces, model["f"]),
    ):
        assert np.array_equal(ours, theirs.astype(ours.dtype))
    assert flame.parents.tolist() == [-1, 0, 1, 1, 1]


def test_chumpy_makes_no_difference(flame_2020_pickle, flame_2020, tmp_path):
    plain = load_flame(write_synthetic_flame(tmp_path, "2020", chumpy=False))
    assert b"chumpy" in flame_2020_pickle.read_bytes()[:100_000]
    assert np.array_equal(plain.v_template, flame_2020.v_template)
    assert np.array_equal(plain.shapedirs, flame_2020.shapedirs)


def test_head_model_runs_on_it(flame_2020):
    head = HeadModel(flame_2020)
    assert (head.num_identity, head.layout.slice("expression")) == (300, slice(0, 100))
    assert "eyelids" in head.layout
    # 100 expressions, 6 numbers for each of 5 rotations, 2 eyelids (method notes: 129 with
    # translation and without the neck, which FLAME trackers leave alone).
    assert head.layout.feature_size() == 132
    at_rest = head(torch.zeros(head.layout.size))
    assert torch.equal(at_rest, torch.from_numpy(flame_2020.v_template))
    theta = torch.zeros(head.layout.size)
    theta[head.layout.slice("jaw")] = torch.tensor([0.3, 0.0, 0.0])
    moved = (head(theta) - at_rest).norm(dim=-1)
    lower, upper = flame_2020.vertex_groups["lower_teeth"], flame_2020.vertex_groups["upper_teeth"]
    assert moved[lower].min() > 5e-3
    assert moved[upper].max() < 1e-7


def test_eyelids_move_only_their_own_eye(flame_2020):
    head = HeadModel(flame_2020)
    theta = torch.zeros(2, head.layout.size)
    theta[:, head.layout.slice("eyelids")] = torch.eye(2)
    moved = (head(theta) - torch.from_numpy(flame_2020.v_template)).norm(dim=-1) > 1e-3
    assert (flame_2020.v_template[moved[0].numpy(), 0] > 0).all()
    assert (flame_2020.v_template[moved[1].numpy(), 0] < 0).all()
    assert moved.any(1).all()


def test_anchors_cover_the_teeth_and_never_lie_on_unmapped_triangles(flame_2020):
    head = HeadModel(flame_2020)
    carrying = uv_anchors(head.uv, head.uv_faces, 256).triangle_index.unique()
    corners = head.uv[head.uv_faces]
    unmapped = (corners == corners[:, :1]).all(-1).all(-1)
    assert unmapped.sum() >= 60
    assert not unmapped[carrying].any()
    assert set(range(9976, 9976 + 56)) <= set(carrying.tolist())


def test_fewer_directions_are_the_first_ones(flame_2020_pickle, flame_2020):
    few = load_flame(flame_2020_pickle, num_identity=10, num_expressions=50, teeth=False)
    assert few.shapedirs.shape == (5023, 3, 60)
    assert np.array_equal(few.shapedirs[..., :10], flame_2020.shapedirs[:5023, :, :10])
    assert np.array_equal(few.shapedirs[..., 10:], flame_2020.shapedirs[:5023, :, 300:350])
    with pytest.raises(UserError, match="num_expressions is 101"):
        load_flame(flame_2020_pickle, num_expressions=101)


# Finding the files


@pytest.fixture
def models(flame_2020_pickle, python_read, tmp_path) -> Path:
    """Links to two versions in a folder."""
    for name, source in (
        ("FLAME2020/generic_model", flame_2020_pickle),
        ("flame2023", python_read[0]),
    ):
        path = tmp_path / f"{name}.pkl"
        path.parent.mkdir(exist_ok=True)
        path.symlink_to(source)
        shutil.copy(source.parent / "head_template.obj", path.parent)
    return tmp_path


def test_environment_variable_names_file_or_folder(flame_2020_pickle, monkeypatch):
    monkeypatch.delenv(FLAME_VARIABLE, raising=False)
    with pytest.raises(UserError, match="none is named") as missing:
        load_flame()
    assert "https://flame.is.tue.mpg.de" in missing.value.remedy
    assert FLAME_VARIABLE in missing.value.remedy
    monkeypatch.setenv(FLAME_VARIABLE, str(flame_2020_pickle.parent.parent))
    assert load_flame().name == "FLAME 2020"
    monkeypatch.setenv(FLAME_VARIABLE, "/nowhere")
    with pytest.raises(UserError, match="no FLAME model at /nowhere"):
        load_flame()


def test_the_version_chooses_among_several_models(models):
    assert load_flame(models, version="2023").name == "FLAME 2023"
    assert load_flame(models, version="2020").name == "FLAME 2020"
    with pytest.raises(UserError, match="several FLAME models"):
        load_flame(models)
    with pytest.raises(UserError, match="no pickle of FLAME 2023 Open"):
        load_flame(models, version="2023 Open")
    with pytest.raises(UserError, match="no FLAME 1999"):
        load_flame(models, version="1999")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("FLAME2017/generic_model.pkl", "FLAME 2017"),
        ("FLAME2020/female_model.pkl", "FLAME 2020 female"),
        ("flame2023_Open.pkl", "FLAME 2023 Open"),
        ("flame2023_no_jaw.pkl", "FLAME 2023"),
        ("x/generic_model.pkl", "FLAME 2020"),
    ],
)
def test_the_version_is_read_off_the_name(flame_2020_pickle, tmp_path, name, told):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(flame_2020_pickle)
    assert load_flame(path, uv=flame_2020_pickle.parent / "head_template.obj").name == told


def test_a_name_without_a_version_is_refused_unless_it_is_given(flame_2020_pickle, tmp_path):
    path = tmp_path / "model.pkl"
    path.symlink_to(flame_2020_pickle)
    template = flame_2020_pickle.parent / "head_template.obj"
    with pytest.raises(UserError, match=r"model\.pkl does not say which version"):
        load_flame(path, uv=template)
    assert load_flame(path, uv=template, version="2017").name == "FLAME 2017"


def test_other_pickles_wrong_shapes_and_nan_are_refused(python_read, tmp_path):
    path = tmp_path / "flame2020.pkl"
    model = python_read[1]
    for wrong, told in (
        ([1], "but a list"),
        ({"v_template": np.zeros(3)}, "lacks shapedirs"),
        (print, "not on the list"),
        ({**model, "shapedirs": model["shapedirs"][..., :150]}, "shapedirs has the shape"),
        ({**model, "weights": model["weights"] * np.nan}, "weights holds no finite"),
        ({**model, "kintree_table": np.zeros((2, 5))}, "has the joints"),
    ):
        path.write_bytes(pickle.dumps(wrong, 4))
        with pytest.raises(UserError, match=told):
            load_flame(path, uv=python_read[0].parent / "head_template.obj")


# UV maps and eyelids


def test_npz_and_shuffled_obj_give_the_same_map(flame_2020_pickle, flame_2020, tmp_path):
    faces, triangles = flame_2020.faces[:9976], flame_2020.uv_faces[:9976]
    uv = flame_2020.uv[: triangles.max() + 1]
    np.savez(tmp_path / "uv.npz", vt=uv, ft=triangles)
    lines = (flame_2020_pickle.parent / "head_template.obj").read_text().splitlines()
    generator = np.random.default_rng(0)
    corners = [line.split()[1:] for line in lines if line.startswith("f ")]
    for i in generator.integers(0, len(corners), 500):
        corners[i] = corners[i][1:] + corners[i][:1]
    generator.shuffle(corners)
    others = [line for line in lines if not line.startswith("f ")]
    shuffled = others + [f"f {' '.join(parts)}" for parts in corners]
    (tmp_path / "shuffled.obj").write_text("\n".join(shuffled))
    for name in ("uv.npz", "shuffled.obj"):
        read_uv, read_faces = read_uv_map(tmp_path / name, faces)
        assert np.allclose(read_uv[read_faces], uv[triangles], atol=1e-6)


def test_damaged_or_foreign_uv_maps_are_refused(flame_2020, tmp_path):
    faces = flame_2020.faces[:9976]
    for name, text, told in (
        ("none.obj", "v 0 0 0\nf 1 2 3\n", "no triangles with UV"),
        ("few.obj", "vt 0 0\nf 1/1 2/1 3/1\n", "maps 1 triangles"),
        ("foreign.obj", "vt 0 0\n" + "f 1/1 2/1 3/1\n" * 9976, "another mesh"),
        ("broken.obj", "vt x y\n", "cannot be read"),
        ("broken.npz", "x", "cannot be read"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(UserError, match=told):
            read_uv_map(tmp_path / name, faces)
    triangles = np.zeros((9976, 3), int)
    for arrays, told in (
        ({"x": np.zeros(1)}, "no UV map"),
        ({"vt": np.full((3, 2), 5.0), "ft": triangles}, "unit square"),
        ({"vt": np.full((3, 2), np.nan), "ft": triangles}, "damaged"),
    ):
        np.savez(tmp_path / "map.npz", **arrays)
        with pytest.raises(UserError, match=told):
            read_uv_map(tmp_path / "map.npz", faces)
    with pytest.raises(UserError, match="no UV map"):
        read_uv_map(tmp_path / "nowhere.obj", faces)


def test_without_a_uv_map_one_is_made_with_a_warning(
    monkeypatch, flame_2020_pickle, flame_2020, tmp_path
):
    path = tmp_path / "flame" / "flame2020.pkl"
    path.parent.mkdir()
    path.symlink_to(flame_2020_pickle)
    monkeypatch.setattr(
        "rgbavatar_ns.head.flame.make_uv_map",
        lambda vertices, faces: (np.zeros((3, 2)), np.zeros_like(faces)),
    )
    with pytest.warns(UserWarning, match="No UV map lies beside FLAME 2020"):
        assert load_flame(path, teeth=False).eyelid_dirs is None


def test_a_made_uv_map_has_no_overlap_and_leaves_room_for_teeth():
    sphere = np.random.default_rng(0).normal(size=(200, 3))
    sphere = sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    faces = scipy.spatial.ConvexHull(sphere).simplices.astype(np.int64)
    uv, uv_faces = make_uv_map(sphere, faces)
    assert uv_faces.shape == faces.shape
    assert uv.min() >= 0
    assert uv[:, 1].max() <= 0.95
    corners = uv[uv_faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = abs(np.linalg.det(edges)).sum() / 2
    covered = len(uv_anchors(torch.from_numpy(uv), torch.from_numpy(uv_faces), 512).triangle_index)
    assert covered / 512**2 == pytest.approx(area, rel=0.02)


def test_eyelids_are_checked(flame_2020_pickle, tmp_path):
    with pytest.raises(UserError, match="lacks l_eyelid"):
        load_flame(flame_2020_pickle, eyelids=tmp_path)
    np.save(tmp_path / "l_eyelid.npy", np.zeros((5, 3)))
    np.save(tmp_path / "r_eyelid.npy", np.zeros((5023, 3)))
    with pytest.raises(UserError, match="no eyelid offsets"):
        load_flame(flame_2020_pickle, eyelids=tmp_path)
