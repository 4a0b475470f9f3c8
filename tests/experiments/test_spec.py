"""What is wrong with an experiment's file is told before anything runs."""

from pathlib import Path

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import cells_of, read_experiment
from rgbavatar_ns.experiments.overrides import with_overrides
from rgbavatar_ns.experiments.sweep import check_experiment
from rgbavatar_ns.plugin.presets import presets

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))

GOOD = """
title: Two widths
preset: rgbavatar-tiny
base: {max_num_iterations: 10}
variants:
  - name: narrow
    set: {pipeline.model.avatar.hidden_width: 16}
    paper: {psnr: 30.5}
  - name: wide
seeds: [0, 1]
subjects: [demo, "demo:3:20:64"]
tiny:
  seeds: [7]
  base: {max_num_iterations: 2}
"""


def _read(tmp_path, text, **options):
    path = tmp_path / "widths.yaml"
    path.write_text(text)
    return read_experiment(path, **options)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
@pytest.mark.parametrize("tiny", [False, True])
def test_rates_that_fall_do_so_within_a_run_that_ends_by_the_clock(path, tiny):
    """Its max_num_iterations is no length: rates would stay where they begin."""
    experiment, known = read_experiment(path, tiny=tiny), presets()
    for variant in experiment.variants:
        preset = known[variant.preset or experiment.preset]
        config = with_overrides(preset, {**experiment.base, **variant.overrides})
        falls = config.position_lr_final is not None or config.learning_rate_factor != 1
        if config.max_train_seconds is not None and falls:
            assert config.learning_rate_steps is not None, variant.name


def test_cells_are_variants_by_subjects_by_seeds(tmp_path):
    experiment = _read(tmp_path, GOOD)
    check_experiment(experiment)
    cells = cells_of(experiment)
    assert experiment.name == "widths"
    assert [(c.variant, c.subject, c.seed) for c in cells[:4]] == [
        ("narrow", "demo", 0),
        ("narrow", "demo", 1),
        ("narrow", "demo:3:20:64", 0),
        ("narrow", "demo:3:20:64", 1),
    ]
    assert len(cells) == 8
    assert cells[0].overrides == {
        "max_num_iterations": 10,
        "pipeline.model.avatar.hidden_width": 16,
    }
    assert len({cell.key for cell in cells}) == 8


def test_tiny_replaces_and_adds_to_the_base(tmp_path):
    experiment = _read(tmp_path, GOOD, tiny=True)
    assert experiment.seeds == (7,)
    assert experiment.base == {"max_num_iterations": 2}
    assert experiment.subjects == ("demo", "demo:3:20:64")


def test_a_cell_is_known_by_what_decides_its_result(tmp_path):
    first, other = cells_of(_read(tmp_path, GOOD)), cells_of(_read(tmp_path, GOOD))
    assert [cell.key for cell in first] == [cell.key for cell in other]
    renamed = cells_of(_read(tmp_path, GOOD.replace("name: wide", "name: broad")))
    assert [cell.key for cell in renamed] == [cell.key for cell in first]
    longer = cells_of(_read(tmp_path, GOOD.replace("iterations: 10", "iterations: 11")))
    assert not {cell.key for cell in longer} & {cell.key for cell in first}


def test_options_have_one_spelling(tmp_path):
    """As in Python and as on command lines: one cell."""
    dashed = GOOD.replace("max_num", "max-num").replace("hidden_width", "hidden-width")
    assert dashed != GOOD
    experiment = _read(tmp_path, dashed)
    check_experiment(experiment)
    assert cells_of(experiment) == cells_of(_read(tmp_path, GOOD))
    text = """
title: Grid
preset: rgbavatar
plot: pipeline.model.avatar.num-bases
grid: {pipeline.model.avatar.num-bases: [5, 10]}
"""
    grid = _read(tmp_path, text)
    assert grid.plot == "pipeline.model.avatar.num_bases"
    assert [set(variant.overrides) for variant in grid.variants] == [{grid.plot}] * 2
    tiny = GOOD.replace("{max_num_iterations: 2}", "{max-num-iterations: 2}")
    assert _read(tmp_path, tiny, tiny=True).base == {"max_num_iterations": 2}


def test_a_variant_may_have_a_preset_of_its_own(tmp_path):
    text = """
title: Two presets
preset: rgbavatar-paper
variants:
  - name: offline
  - name: online
    preset: rgbavatar-paper-online
    set: {steps_after_stream: 3, pipeline.datamanager.local-size: 20}
"""
    experiment = _read(tmp_path, text)
    check_experiment(experiment)
    cells = cells_of(experiment)
    assert [cell.preset for cell in cells] == ["rgbavatar-paper", "rgbavatar-paper-online"]
    assert len({cell.key for cell in cells}) == 2
    for wrong, told in (
        (text.replace("    preset: rgbavatar-paper-online\n", ""), "no field of the preset"),
        (text.replace("paper-online", "paper-onlin"), "Did you mean 'rgbavatar-paper-online'"),
        (text.replace("preset: rgbavatar-paper-online", "preset: 3"), "Give text there"),
    ):
        with pytest.raises(UserError) as refused:
            check_experiment(_read(tmp_path, wrong))
        assert told in str(refused.value)


def test_optimisers_are_options_too(tmp_path):
    rate = "optimizers.basis-color.optimizer.lr"
    experiment = _read(tmp_path, GOOD.replace("{max_num_iterations: 10}", f"{{{rate}: 0.5}}"))
    check_experiment(experiment)
    assert cells_of(experiment)[0].overrides[rate.replace("-", "_")] == 0.5
    unknown = _read(tmp_path, GOOD.replace("{max_num_iterations: 10}", "{optimizers.colour.lr: 1}"))
    with pytest.raises(UserError, match=r"Did you mean 'optimizers\.color'"):
        check_experiment(unknown)
    whole = _read(tmp_path, GOOD.replace("{max_num_iterations: 10}", "{optimizers.color: 1}"))
    with pytest.raises(UserError, match="no single option"):
        check_experiment(whole)


def test_subjects_of_the_command_line_make_another_experiment(tmp_path, monkeypatch):
    (tmp_path / "films" / "bala").mkdir(parents=True)
    (tmp_path / "more" / "bala").mkdir(parents=True)
    plain = _read(tmp_path, GOOD)
    monkeypatch.chdir(tmp_path / "films")
    chosen = _read(tmp_path, GOOD, subjects=("bala", "demo:4:20:64"))
    assert {cell.subject for cell in cells_of(chosen)} == {
        str(tmp_path / "films" / "bala"),
        "demo:4:20:64",
    }
    assert chosen.name.startswith("widths-bala-demo-4-20-64-")
    monkeypatch.chdir(tmp_path / "more")
    other = _read(tmp_path, GOOD, subjects=("bala", "demo:4:20:64"))
    assert len({plain.name, chosen.name, other.name}) == 3
    many = _read(tmp_path, GOOD, subjects=[f"demo:{k}" for k in range(9)])
    assert "-and-6-more-" in many.name
    with pytest.raises(UserError, match="does not exist"):
        cells_of(_read(tmp_path, GOOD, subjects=("gone",)))
    with pytest.raises(UserError, match="no subjects"):
        _read(tmp_path, GOOD, subjects=())


def test_a_grid_multiplies_the_variants(tmp_path):
    text = """
title: Grid
preset: rgbavatar
variants: [{name: a}, {name: b, set: {max_num_iterations: 7}}]
grid: {pipeline.model.avatar.num_bases: [5, 10], machine.seed: [1]}
"""
    experiment = _read(tmp_path, text)
    assert [variant.name for variant in experiment.variants] == [
        "a, num_bases 5, seed 1",
        "a, num_bases 10, seed 1",
        "b, num_bases 5, seed 1",
        "b, num_bases 10, seed 1",
    ]
    assert [variant.family for variant in experiment.variants] == ["a", "a", "b", "b"]
    assert experiment.variants[3].overrides["max_num_iterations"] == 7


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("hidden_width", "hiden_width", "Did you mean 'pipeline.model.avatar.hidden_width'"),
        ("pipeline.model", "pipeline.modle", "Did you mean 'pipeline.model'"),
        ("width: 16", "width: broad", "does not fit its type int"),
        ("width: 16", "width: 1.5", "does not fit its type int"),
        ("width: 16", "width: 0", "hidden-width is 0. Give a number from 1 to 8,192"),
        ("iterations: 10", "iterations: -3", "cannot be trained: --max-num-iterations is -3"),
        ("set: {", "set: {machine.seed: -1, ", "--machine.seed is -1"),
        ("set: {", "set: {optimizers.color.optimizer.lr: 0.01, mixed_precision: true, ", "scaling"),
        ("rgbavatar-tiny", "rgbavatar-tine", "Did you mean 'rgbavatar-tiny'"),
        ("seeds:", "seads:", "Did you mean 'seeds'"),
        ("seeds: [0, 1]", "seeds: []", "no seeds"),
        ("seeds: [0, 1]", "seeds: [-1]", "0 or more"),
        ("seeds: [0, 1]", "seeds: 3", "Give a list"),
        ("psnr: 30.5", "psnrr: 30.5", "Did you mean 'psnr'"),
        ("psnr: 30.5", "psnr: high", "Give figures by metric"),
        ("paper: {psnr: 30.5}", "paper_by_subject: {bala: 3}", "Give figures by metric"),
        ("paper: {psnr: 30.5}", "paper_by_subject: 3", "Give a mapping there"),
        ("base: {max_num", "base: {max-num-iterations: 3, max_num", "twice"),
        ("name: wide", "name: narrow", "two variants named"),
        ("title: Two widths", "", "lacks `title`"),
        ("title: Two widths", "title: [", "cannot be read"),
        ('"demo:3:20:64"', "no/such/folder", "does not exist"),
    ],
)
def test_each_mistake_is_named_with_its_remedy(tmp_path, old, new, told):
    assert old in GOOD

    def read_and_check():
        experiment = _read(tmp_path, GOOD.replace(old, new))
        check_experiment(experiment)
        cells_of(experiment)

    with pytest.raises(UserError) as refused:
        read_and_check()
    assert told in str(refused.value)


def test_options_that_refuse_one_another_are_told_before_any_variant_trains(tmp_path):
    text = """
title: Last
preset: gaussianavatars-style
variants:
  - name: good
    set: {pipeline.model.avatar.density.min_opacity: 0.02, DENSITY.reset_opacity: 0.05}
  - name: bad
    set: {pipeline.model.avatar.density.min_opacity: 0.2}
""".replace("DENSITY", "pipeline.model.avatar.density")
    with pytest.raises(UserError, match=r"variant 'bad', cannot be trained: .*all be removed"):
        check_experiment(_read(tmp_path, text))
    check_experiment(_read(tmp_path, text.split("  - name: bad")[0]))


def test_numbers_need_no_dot(tmp_path):
    """YAML 1.1, which the reader follows, takes 8e-4 for text."""
    rate = "optimizers.position.optimizer.lr"
    plain, short = (
        _read(
            tmp_path,
            GOOD.replace("{max_num_iterations: 10}", f"{{{rate}: {number}}}").replace(
                "psnr: 30.5", f"e_orth: {number}"
            ),
        )
        for number in ("0.0008", "8e-4")
    )
    assert _read(tmp_path, GOOD.replace("30.5", "+.5e2")).variants[0].paper == {"psnr": 50.0}
    check_experiment(short)
    assert short.variants[0].paper == {"e_orth": 0.0008}
    assert cells_of(short) == cells_of(plain)
    assert [cell.key for cell in cells_of(short)] == [cell.key for cell in cells_of(plain)]
    for text in ("8e", "e-4", "1e4x", "'8e-4'"):
        wrong = GOOD.replace("{max_num_iterations: 10}", f"{{{rate}: {text}}}")
        with pytest.raises(UserError, match="does not fit its type float"):
            check_experiment(_read(tmp_path, wrong))


def test_an_empty_grid_is_refused(tmp_path):
    with pytest.raises(UserError, match="Give a list of values"):
        _read(tmp_path, "title: t\npreset: rgbavatar\ngrid: {max_num_iterations: []}\n")
    with pytest.raises(UserError, match="varies nothing"):
        _read(tmp_path, "title: t\npreset: rgbavatar\n")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
@pytest.mark.parametrize("tiny", [False, True])
def test_the_experiments_that_ship_fit_the_presets(path, tiny):
    experiment = read_experiment(path, tiny=tiny)
    check_experiment(experiment)
    assert cells_of(experiment)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_rows_with_the_papers_figures_run_the_papers_preset(path):
    """Whoever runs them gets the paper; with --tiny nobody does, which the table then says."""
    experiment = read_experiment(path)
    for variant in experiment.variants:
        if variant.paper or variant.paper_by_subject or variant.name in ("Ours", "paper"):
            preset = variant.preset or experiment.preset
            papers = preset in ("rgbavatar-paper", "rgbavatar-paper-online")
            # The methods that the paper compares itself with.
            assert papers or preset.endswith("-style"), variant.name


def test_the_main_tables_means_are_of_the_papers_subjects():
    """INSTA's eight; the four others are of the GaussianBlendShapes dataset."""
    quality = next(path for path in CONFIGS if path.stem == "quality")
    rows = {variant.name: variant for variant in read_experiment(quality).variants}
    for name in ("Ours", "Ours (w/ LPIPS)", "Ours (online)"):
        figures = rows[name].paper_by_subject
        insta = [one for subject, one in figures.items() if not subject.startswith("subject")]
        assert (len(insta), len(figures)) == (8, 12)
        for metric, digits in (("psnr", 0.006), ("ssim", 6e-5), ("lpips_vgg", 6e-5)):
            mean = sum(one[metric] for one in insta) / 8
            assert mean == pytest.approx(rows[name].paper[metric], abs=digits)
    assert rows["Ours"].paper["frames_per_second"] == 398
    assert rows["Ours (w/ LPIPS)"].overrides["pipeline.model.lpips_weight"] == 0.05
    assert "pipeline.model.lpips_start_step" not in rows["Ours (w/ LPIPS)"].overrides
