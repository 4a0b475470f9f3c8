"""The folders of systems that share `.frame` files, FlashAvatar's places, VHAP's raw output."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.data.importers import FORMATS, ImportOptions, find_format, read_source
from rgbavatar_ns.data.importers.frame_images import make_png
from rgbavatar_ns.data.png import decode_png_rgba
from rgbavatar_ns.errors import UserError
from tests.data.importers.takes import FIRST, HEIGHT, NUM_FRAMES, WIDTH
from tests.data.importers.test_round_trips import assert_same_views, write


@pytest.fixture
def options(flame_folder) -> ImportOptions:
    return ImportOptions(flame=flame_folder, teeth=False)


@pytest.fixture
def frame_folder(tmp_path, takes) -> Path:
    """`checkpoint` and `images` alone."""
    folder = tmp_path / "subject"
    write(folder, "insta", takes)
    for path in folder.glob("transforms*.json"):
        path.unlink()
    for name in ("meshes", "flame"):
        shutil.rmtree(folder / name)
    return folder


def image(source, position: int) -> np.ndarray:
    png = make_png(source.frame_images[position], (WIDTH, HEIGHT)).encoded
    return decode_png_rgba(png, "")


def test_rgbavatars_own_folder_is_paired_in_order(frame_folder, options, takes):
    take, frames = takes("2020", True)
    source = read_source(frame_folder, options)
    assert source.format == "RGBAvatar"
    assert_same_views(take, frames, source)
    third = image(source, 2)
    for path in sorted((frame_folder / "images").iterdir()):
        path.rename(path.with_name(f"shot{int(path.stem) + 100}.png"))
    moved = read_source(frame_folder, options)
    assert torch.equal(moved.theta, source.theta)
    assert np.array_equal(image(moved, 2), third)
    assert any("paired in order" in note for note in moved.notes)
    (frame_folder / "images/shot103.png").unlink()
    with pytest.raises(UserError, match="without a record"):
        read_source(frame_folder, options)


def test_gaussian_blendshapes_and_nerf_blend_shape(frame_folder, options, takes):
    take, frames = takes("2020", True)
    (frame_folder / "canonical.obj").write_text("v 0 0 0\n")
    source = read_source(frame_folder, options)
    assert source.format == "GaussianBlendshapes"
    assert_same_views(take, frames, source)
    assert "last 350" in source.notes[-1]
    masks = frame_folder / "image_mask"
    masks.mkdir()
    (frame_folder / "bc.jpg").write_bytes(b"")
    for frame in frames:
        mask = np.full((HEIGHT, WIDTH), 10 * frame.index, np.uint8)
        cv2.imwrite(str(masks / f"mask_{frame.index:05d}.png"), mask)
    source = read_source(frame_folder, options)
    assert source.format == "NeRFBlendShape"
    assert "last 500" in source.notes[-1]
    assert (image(source, 1)[..., 3] == 10 * (FIRST + 1)).all()


def test_held_out_frames_can_be_counted(frame_folder, options):
    source = read_source(frame_folder, ImportOptions(flame=options.flame, test_frames=4))
    assert source.test == frozenset(range(FIRST + NUM_FRAMES - 4, FIRST + NUM_FRAMES))
    with pytest.raises(UserError, match="6 cannot be held out"):
        read_source(frame_folder, ImportOptions(flame=options.flame, test_frames=6))


def test_flashavatar_beside_its_tracker_and_from_above(tmp_path, options, takes):
    take, frames = write(tmp_path / "dataset" / "obama", "flashavatar", takes)
    output = tmp_path / "metrical-tracker/output"
    output.mkdir(parents=True)
    shutil.move(tmp_path / "dataset/obama/metrical-tracker/output/obama", output / "obama")
    for folder in (tmp_path, tmp_path / "dataset/obama"):
        source = read_source(folder, options)
        assert source.format == "FlashAvatar"
        assert_same_views(take, frames, source)
        assert source.frame_images[0].color.name == f"{FIRST + 1:05d}.jpg"
    (tmp_path / "dataset/other/imgs").mkdir(parents=True)
    with pytest.raises(UserError, match="2 subjects"):
        read_source(tmp_path, options)


def test_flashavatar_images_that_are_counted_as_frames_are_refused(tmp_path, options, takes):
    write(tmp_path / "data", "flashavatar", takes)
    for path in sorted((tmp_path / "data/imgs").iterdir()):
        path.rename(path.with_name(f"{int(path.stem) - 1:05d}.jpg"))
    with pytest.raises(UserError, match="image n of FlashAvatar belongs to frame n - 1") as caught:
        read_source(tmp_path / "data", options)
    assert "one higher" in caught.value.remedy


def test_flashavatars_parsing_masks_cut_the_matte(tmp_path, options, takes):
    write(tmp_path / "data", "flashavatar", takes)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for number in range(FIRST + 1, FIRST + 1 + NUM_FRAMES):
        cv2.imwrite(str(tmp_path / f"data/parsing/{number:05d}_neckhead.png"), mask)
        cv2.imwrite(str(tmp_path / f"data/parsing/{number:05d}_mouth.png"), np.zeros_like(mask))
    whole = read_source(tmp_path / "data", options)
    head = read_source(tmp_path / "data", ImportOptions(flame=options.flame, region="head"))
    alpha, cut = image(whole, 0)[..., 3], image(head, 0)[..., 3]
    assert np.array_equal(cut[:, : WIDTH // 2], alpha[:, : WIDTH // 2])
    assert not cut[:, WIDTH // 2 :].any()
    assert alpha[:, WIDTH // 2 :].any()


def test_metrical_pictures_may_lie_elsewhere_and_found_mattes_stay(
    tmp_path, options, takes, monkeypatch
):
    _, frames = write(tmp_path / "data", "metrical", takes)
    shutil.move(tmp_path / "data/input", tmp_path / "film")
    monkeypatch.chdir(tmp_path)
    source = read_source(Path("data"), replace(options, format="metrical", images=Path("film")))
    assert np.array_equal(image(source, 3), frames[3].image_rgba)
    shutil.copytree("data/alpha", "mattes")
    for path in Path("mattes").iterdir():
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 77, np.uint8))
    named = replace(options, format="metrical", images=Path("film"), masks=Path("mattes"))
    assert (image(read_source(Path("data"), named), 3)[..., 3] == 77).all()
    for name in ("images", "masks"):
        with pytest.raises(UserError, match="There is no folder alpha"):  # it lies in the data
            read_source(Path("data"), replace(named, **{name: Path("alpha")}))


def test_vhaps_raw_output(tmp_path, options, takes):
    _, frames = write(tmp_path / "export", "vhap", takes)
    raw = tmp_path / "raw"
    (raw / "images").mkdir(parents=True)
    (raw / "fg_masks").mkdir()
    columns: dict[str, list[np.ndarray]] = {}
    for frame in frames:
        name = f"{frame.index:05d}"
        # The tracker reads the film itself; only the export lays it over white.
        film = cv2.cvtColor(frame.image_rgba, cv2.COLOR_RGBA2BGR)
        cv2.imwrite(str(raw / f"images/{name}.png"), film)
        shutil.copy(tmp_path / f"export/fg_masks/{name}_00.png", raw / f"fg_masks/{name}.png")
        with np.load(tmp_path / f"export/flame_param/{name}.npz") as values:
            for key in values.files:
                columns.setdefault(key, []).append(values[key])
    stacked = {
        key: column[0] if key in ("shape", "static_offset") else np.concatenate(column)
        for key, column in columns.items()
    }
    stacked["timestep_id"] = np.array([f"{frame.index:05d}" for frame in frames])
    stacked["focal_length"] = np.array([1.5])
    np.savez(raw / "tracked_flame_params_0.npz", **{**stacked, "expr": stacked["expr"] * 0})
    np.savez(raw / "tracked_flame_params_30.npz", **stacked)
    source = read_source(raw, options)
    exported = read_source(tmp_path / "export", options)
    assert torch.equal(source.theta, exported.theta)
    assert np.array_equal(image(source, 3), frames[3].image_rgba)
    assert torch.equal(source.cameras.focal_px, torch.full((NUM_FRAMES, 2), 1.5 * WIDTH))
    # A point .1 m to the right of and .2 m above the head's origin, which is 1 m ahead.
    seen = source.cameras.world_to_camera[0] @ torch.tensor([0.1, 0.2, 0.0, 1.0])
    assert torch.allclose(seen, torch.tensor([0.1, -0.2, 1.0, 1.0]))
    del stacked["focal_length"]
    np.savez(raw / "tracked_flame_params_30.npz", **stacked)
    with pytest.raises(UserError, match="calibrated"):
        read_source(raw, options)


def test_vhaps_white_is_taken_off_and_a_film_that_lies_over_none_stays(tmp_path, options, takes):
    _, frames = write(tmp_path / "export", "vhap", takes)
    picture, frame = tmp_path / f"export/images/{FIRST:05d}_00.png", frames[0]
    alpha = frame.image_rgba[..., 3]
    assert (cv2.imread(str(picture))[alpha == 0] == 255).all()
    straight = image(read_source(tmp_path / "export", options), 0)
    # By hand: red 100 at alpha 51 (a fifth) over white is 20 + 204.
    half_seen = np.zeros((HEIGHT, WIDTH), np.uint8)
    half_seen[:, WIDTH // 2 :] = 51
    half_seen[0, -1] = 255
    cv2.imwrite(str(tmp_path / f"export/fg_masks/{FIRST:05d}_00.png"), half_seen)
    over = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    over[:, WIDTH // 2 :] = (255, 255, 224)
    cv2.imwrite(str(picture), over)
    seen = image(read_source(tmp_path / "export", options), 0)
    assert (seen[:, : WIDTH // 2] == 0).all()
    assert tuple(seen[0, -1]) == (224, 255, 255, 255)
    assert (seen[1:, WIDTH // 2 :] == (100, 255, 255, 51)).all()
    off = np.abs(straight.astype(int) - frame.image_rgba)
    assert off[alpha > 100].max() <= 3
    film = cv2.cvtColor(frame.image_rgba, cv2.COLOR_RGBA2BGR)
    cv2.imwrite(str(picture), film)
    cv2.imwrite(str(tmp_path / f"export/fg_masks/{FIRST:05d}_00.png"), alpha)
    assert np.array_equal(image(read_source(tmp_path / "export", options), 0), frame.image_rgba)


def test_vhaps_static_offset_is_the_subjects_head_at_rest(tmp_path, options, takes):
    take, _ = write(tmp_path / "export", "vhap", takes)
    offset = np.random.default_rng(3).normal(0, 1e-3, (1, 5143, 3)).astype(np.float32)
    changed: dict[str, np.ndarray] = {}
    for path in (tmp_path / "export/flame_param").iterdir():
        with np.load(path) as values:
            changed = {**values, "static_offset": offset}
        np.savez(path, **changed)
    source = read_source(tmp_path / "export", options)
    assert np.allclose(source.arrays.v_template, take.arrays.v_template + offset[0, :5023])
    with_teeth = read_source(tmp_path / "export", ImportOptions(flame=options.flame))
    assert len(with_teeth.arrays.v_template) == 5143
    path = tmp_path / f"export/flame_param/{FIRST + 1:05d}.npz"
    np.savez(path, **{**changed, "static_offset": offset * 2})
    with pytest.raises(UserError, match=r"another head shape than the first: 1"):
        read_source(tmp_path / "export", options)


def test_imavatars_older_intrinsics_are_pixels_of_a_picture_of_512(tmp_path, options, takes):
    take, frames = write(tmp_path, "imavatar", takes)
    path = tmp_path / "flame_params.json"
    content = json.loads(path.read_text())
    content["intrinsics"] = [512 * value for value in content["intrinsics"]]
    path.write_text(json.dumps(content))
    assert_same_views(take, frames, read_source(tmp_path, options))
    # By hand: three widths and heights of focal length, the principal point in the middle.
    content["intrinsics"] = [-1536, 1536, 256, 256]
    path.write_text(json.dumps(content))
    cameras = read_source(tmp_path, options).cameras
    assert cameras.focal_px[0].tolist() == [3 * WIDTH, 3 * HEIGHT]
    assert cameras.principal_point_px[0].tolist() == [WIDTH / 2, HEIGHT / 2]


@pytest.mark.parametrize("intrinsics", [[-3, 3, 256, 0.5], [-1500, 1500, 256, 2000], [3, 3, 0, -9]])
def test_imavatars_principal_point_far_outside_is_refused(tmp_path, options, takes, intrinsics):
    write(tmp_path, "imavatar", takes)
    path = tmp_path / "flame_params.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"intrinsics": intrinsics}))
    with pytest.raises(UserError, match="has a principal point at") as caught:
        read_source(tmp_path, options)
    assert "picture of 512" in caught.value.remedy


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.key)
def test_a_folder_without_the_files_of_its_format_is_told(known, options, tmp_path):
    (tmp_path / "checkpoint").mkdir()
    for folder in (tmp_path, tmp_path / "checkpoint"):
        with pytest.raises(UserError):
            read_source(folder, replace(options, format=known.key))


@pytest.mark.parametrize("option", ["images", "masks", "region"])
@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.key)
def test_an_option_that_changes_nothing_is_refused(known, option, tmp_path):
    value = "head" if option == "region" else tmp_path
    takers = {"images": ("metrical", "vhap-raw"), "region": ("flashavatar",)}
    with pytest.raises(UserError) as caught:
        read_source(tmp_path, ImportOptions(format=known.key, **{option: value}))
    refused = f"--{option} changes nothing of {known.name} data" in caught.value.cause
    assert refused != (known.key in takers.get(option, takers["images"]))


def test_images_without_a_matte_need_consent(frame_folder, options):
    for path in (frame_folder / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path)))
    with pytest.raises(UserError, match="without a matte") as caught:
        read_source(frame_folder, options)
    assert "--allow-opaque" in caught.value.cause
    opaque = ImportOptions(flame=options.flame, allow_opaque=True)
    assert (image(read_source(frame_folder, opaque), 0)[..., 3] == 255).all()


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda m: m + 0.01 * np.eye(4, k=3), "differ from their .frame file's"),
        (lambda m: m @ np.diag([1, -1, -1, 1]), "axes are OpenGL's, .*"),
    ],
)
def test_insta_cameras_that_contradict_the_trackers_are_told(tmp_path, options, takes, wrong, told):
    write(tmp_path, "insta", takes)
    for path in tmp_path.glob("transforms*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            frame["transform_matrix"] = wrong(np.array(frame["transform_matrix"])).tolist()
        path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=f"{told}: {NUM_FRAMES}"):
        read_source(tmp_path, options)


def test_insta_frames_that_are_told_as_left_out_are(tmp_path, options, takes):
    write(tmp_path, "insta", takes)
    for path in tmp_path.glob("transforms*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            if frame["file_path"] == f"images/{FIRST + 1:05d}.png":
                frame["transform_matrix"][0][3] += 0.01
        path.write_text(json.dumps(content))
    source = read_source(tmp_path, replace(options, allow_partial=True))
    assert any("left out: cameras" in note for note in source.notes)
    assert source.index == tuple(FIRST + k for k in range(NUM_FRAMES) if k != 1)


def test_a_damaged_mesh_is_left_out_whichever_it_is(tmp_path, options, takes):
    write(tmp_path, "insta-meshes", takes)
    meshes = sorted((tmp_path / "meshes").iterdir())
    meshes[2].write_text("v 0 0 0\n")  # one of those that the shape is taken from
    meshes[3].write_text("v 0 0\n")
    meshes[5].write_text("v 0 0\n")  # the next to take its place
    told = f"not FLAME's: 2 .{meshes[2].name}, {meshes[5].name}"
    with pytest.raises(UserError, match=told):
        read_source(tmp_path, options)
    source = read_source(tmp_path, replace(options, allow_partial=True))
    assert source.index == tuple(FIRST + k for k in range(NUM_FRAMES) if k not in (2, 3, 5))
    notes = " ".join(note for note in source.notes if "left out" in note)
    assert [notes.count(meshes[k].name) for k in range(NUM_FRAMES)] == [0, 0, 1, 1, 0, 1]
    for mesh in meshes:
        mesh.write_text("v 0 0 0\n")
    with pytest.raises(UserError, match="has no frames"):
        read_source(tmp_path, replace(options, allow_partial=True))


@pytest.mark.parametrize("allow_partial", [False, True])
def test_meshes_that_insta_simplified_are_told_as_that(tmp_path, options, takes, allow_partial):
    write(tmp_path, "insta-meshes", takes)
    for mesh in (tmp_path / "meshes").iterdir():
        lines = mesh.read_text().splitlines()
        vertices = [line for line in lines if line.startswith("v ")]
        mesh.write_text("\n".join(vertices[:3928]) + "\n")
    with pytest.raises(UserError, match="5023 vertices") as caught:
        read_source(tmp_path, replace(options, allow_partial=allow_partial))
    assert "generate.sh simplifies" in caught.value.remedy
    assert "`checkpoint` folder" in caught.value.remedy


def test_an_unknown_folder_is_none(tmp_path):
    assert find_format(tmp_path) is None
