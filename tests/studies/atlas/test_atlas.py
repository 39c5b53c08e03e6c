"""The atlas: shares against their definition, modes and responses against the machine's own."""

import dataclasses
from functools import partial
from itertools import permutations
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import xarray
from matplotlib.figure import Figure
from PIL import Image

from studies.atlas import (
    attribution,
    claims,
    drawing,
    figures,
    findings,
    platform,
    plots,
    run,
    subsets,
    workspace,
)
from studies.atlas.platform import LINK_SETS, platform_error, responses
from studies.atlas.say import _errors
from studies.atlas.verb import atlas as atlas_of
from studies.engine.modes import machine_modes
from studies.engine.results import read_sweep
from studies.engine.runs import run_study
from studies.errors import StudyError
from tests.canonical import HOME, MACHINE, TINY, study_of
from tests.jobs import quiet_job
from tests.pages import Page, text_of
from tests.studies.test_cli import refused
from tests.studies.test_cli import run as command
from tests.sweeps import narrow_blocks

#: Moves that fit into the run.
PATH = (tuple(HOME), (0.0, 0.001, HOME[2]))
SETTINGS = ((0.02, "ei"), (0.015, "none"))


def small_study(**fields):
    """One move; its programs are those of `MACHINE`."""
    return study_of(MACHINE, control__ratio_source="own_run").change(
        **{"motion__waypoints": PATH} | fields
    )


#: Every figure of the page; two are drawn as they are, the others empty.
DRAWN, EMPTY = (
    ["subsets", "modes"],
    [
        *("helps", "lattice", "shares", "workspace", "participation", "platform", "vibration"),
        *("responses", "mode_shares", "interactions"),
    ],
)


def empty(name):
    """What draws nothing, and says what the figure of that name says."""

    def draw(_):
        return Figure(figsize=(1, 1))

    draw.__name__, draw.__doc__ = name, getattr(figures, name).__doc__
    return draw


@pytest.fixture(scope="module")
def atlas(tmp_path_factory):
    """A small atlas with few real figures: its folder and what was found."""
    folder, kept = tmp_path_factory.mktemp("atlas") / "out", {}

    def look(*arguments):
        kept["found"] = findings.evaluate_atlas(*arguments)
        return kept["found"]

    # what is replaced is part of no program: they are kept
    with (
        narrow_blocks(32),
        mock.patch.multiple(
            run,
            atlas_sweep=partial(subsets.atlas_sweep, settings=SETTINGS),
            evaluate_atlas=look,
            beyond_first=lambda *_: np.array([0.0, 1.0]),  # subsets of modes in the second one
        ),
        mock.patch.multiple(figures, **{name: empty(name) for name in EMPTY}),
        mock.patch.object(platform, "SETTINGS", SETTINGS),
        mock.patch.object(figures, "CLIP", (-0.002, 0.002, 1e-3)),
        mock.patch.multiple(
            findings,
            map_workspace=partial(workspace.map_workspace, count=9),
            FREQUENCY=np.array([1.0, 50.0, 114.0, 300.0]),
        ),
    ):
        assert atlas_of(small_study(), folder, progress=False).folder == folder
    return folder, kept["found"]


def shapley_by_orders(value, count):
    """Mean of what each player adds, over all orders of arrival."""
    share = np.zeros(count)
    orders = list(permutations(range(count)))
    for order in orders:
        subset = 0
        for player in order:
            share[player] += value[subset | 1 << player] - value[subset]
            subset |= 1 << player
    return share / len(orders)


def test_shapley_shares_are_those_of_all_orders_of_arrival():
    value = np.random.default_rng(0).normal(size=16)
    share = attribution.shapley(value)
    np.testing.assert_allclose(share, shapley_by_orders(value, 4), rtol=1e-12)
    assert share.sum() == pytest.approx(value[-1] - value[0], rel=1e-12)


def test_dividends_add_up_to_the_value():
    value = np.random.default_rng(1).normal(size=(2, 8))
    dividend = attribution.dividends(value)
    parts = [[t for t in range(8) if t & s == t] for s in range(8)]
    again = np.stack([dividend[:, part].sum(axis=1) for part in parts], axis=1)
    np.testing.assert_allclose(again, value, rtol=1e-12, atol=1e-12)


def test_interaction_is_what_a_pair_adds_by_being_one():
    size = np.array([(s).bit_count() for s in range(8)])
    pair = ((np.arange(8) & 0b011) == 0b011).astype(float)
    index = attribution.interaction(size + 5 * pair)
    expected = np.zeros((3, 3))
    expected[0, 1] = expected[1, 0] = 5
    np.testing.assert_allclose(index, expected, atol=1e-12)


def test_values_that_are_no_game_are_refused():
    with pytest.raises(ValueError, match="6 values; allowed: 2\\^n"):
        attribution.shapley(np.zeros(6))


def test_shares_of_the_atlas_sum_to_what_is_removed(atlas):
    folder, found = atlas
    game = found.links.removed()
    with xarray.open_dataset(folder / run.DATA) as data:
        modes = data.mode_shapley_share.sum("player")
        for share, whole in ((data.shapley_share.sum("link"), game), (modes, game[1:])):
            np.testing.assert_allclose(share.values, whole[..., -1], rtol=1e-9, atol=1e-12)
        assert np.abs(game[..., -1]).max() > 0.5
        assert np.all(np.isfinite(data.interaction))
        np.testing.assert_array_equal(data.removed.sel(links="1+3"), game[..., 0b101])
        assert data.links.values.tolist() == ["none", "1", "2", "3", "1+2", "1+3", "2+3", "1+2+3"]


def test_subsets_come_in_the_order_of_people():
    names = [subsets.subset_label(k, 1) for k in subsets.in_order(3)]
    assert names == ["none", "1.1", "2.1", "3.1", "1.1+2.1", "1.1+3.1", "2.1+3.1", "1.1+2.1+3.1"]
    two = study_of(TINY)
    spec = subsets.atlas_sweep(two, SETTINGS[:1])
    masks = np.array(spec.data["sweep"]["axes"]["control.mode_mask"])
    assert masks.shape == (15, 3, 2)  # no link once
    assert masks.sum(axis=(1, 2)).tolist() == [0, 1, 2, 1, 2, 1, 2, 2, 4, 2, 4, 2, 4, 3, 6]


def test_modes_matter_where_their_control_changes_something():
    one = made_up(np.ones((8, 3)), np.ones(8))
    seen = one.each(lambda values: np.repeat(values[:, None], 2, axis=1))
    assert subsets.beyond_first(seen, np.full(3, 0.5)).tolist() == [0.0]
    seen.station[0, 1, 0b111, 2] = 0.8  # of link 3, with both modes controlled
    assert subsets.beyond_first(seen, np.full(3, 0.5))[0] == pytest.approx(0.36)
    # a third of that of all links, where link 3 is below an ADC step
    few = subsets.beyond_first(seen, np.array([0.5, 0.5, 2.0]))[0]
    assert few == pytest.approx(0.12)
    assert subsets.beyond_first(seen, np.full(3, 2.0)).tolist() == [0.0]


def test_a_case_of_the_atlas_is_the_run_of_its_study(atlas):
    moved = small_study(motion__move_time=0.015, control__links=(True, False, True))
    metrics = run_study(moved, has_record=False, has_loop=False).result.metrics
    for found, k in ((atlas[1].links, 0b101), (atlas[1].subsets, 0b111000111)):
        assert found.setting[-1] == SETTINGS[1]
        np.testing.assert_allclose(found.station[-1, k], metrics.residual_rms, rtol=1e-6)
        np.testing.assert_allclose(found.pose[-1, k], metrics.pose_error_rms, rtol=1e-6)


def test_atlas_writes_what_its_report_shows(atlas):
    folder = atlas[0]
    text = text_of((folder / "report.html").read_text(encoding="utf-8"))
    assert text.startswith("# Coupling atlas")
    for name in ("subsets.png", "modes.png", figures.ANIMATION, run.DATA):
        assert (folder / name).stat().st_size > 1000
    assert all(f"![{name}]".replace("_", "-") in text for name in (*DRAWN, *EMPTY))
    assert "nan" not in text.lower()
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    assert len(page.images) == len(DRAWN + EMPTY) + 2
    assert page.title == "Coupling atlas"
    with Image.open(folder / figures.ANIMATION) as film:
        assert film.n_frames == 4
    assert not list(folder.glob(".unfinished*"))


def test_vibration_after_a_command_that_ends_the_run(atlas):
    found = atlas[1]
    runs, end = found.platform, found.platform.command_end.max()
    kept = runs.time < end + 0.02
    short = runs.replace(time=runs.time[kept], vibration=runs.vibration[:, :, kept])
    figure = figures.vibration(found.replace(platform=short))
    late = (short.time >= end + 0.01) & (short.time < end + 0.015)
    column = int(np.argmax(runs.command_end))
    for k, ax in enumerate(figure.axes[column:6:2]):
        assert ax.get_ylim()[1] >= 1.4e9 * np.abs(short.vibration[column, :, late, k]).max() > 0


def test_vibration_and_drive_add_up_to_the_error_of_a_run(atlas):
    runs = atlas[1].platform
    moved = small_study(motion__move_time=0.015, control__links=LINK_SETS[1])
    wanted = run_study(moved, has_record=False, has_loop=False).result.metrics.pose_error_rms
    np.testing.assert_allclose(runs.rms(runs.drive[:, None] + runs.vibration)[1, 1], wanted, 1e-6)
    assert np.all(runs.rms(runs.vibration)[1, 1] > 1e-6 * wanted)


def test_stiff_links_leave_drive_error_alone(atlas):
    """Without a shaper, which follows the links' frequencies."""
    runs = atlas[1].platform
    modulus = small_study().link.youngs_modulus
    with mock.patch.object(platform, "SETTINGS", SETTINGS):
        stiff = platform_error(small_study(link__youngs_modulus=4 * modulus))
    np.testing.assert_allclose(stiff.drive[1], runs.drive[1], rtol=1e-9, atol=1e-15)
    assert 2 * stiff.rms(stiff.vibration)[1, 0, 1] < runs.rms(runs.vibration)[1, 0, 1]


def test_static_response_is_the_drive_s_stiffness():
    study = small_study(drive__kp=3e4)
    found = responses(study, np.array([0.01]))
    _x, _y, _phi = study.motion.waypoints[0]
    size = np.abs(found.value[0, 0])
    # slider force over Kp is the slider's way; on the platform (J'Kp J)^-1
    jacobian = np.linalg.inv(np.real(found.value[0, 0, 3:, :3]) * 3e4)
    compliance = np.linalg.inv(jacobian.T @ jacobian) / 3e4
    np.testing.assert_allclose(np.real(found.value[0, 0, 3:, 3:]), compliance, rtol=1e-3, atol=1e-9)
    assert size[:3].max() < 1e-9  # links bend under acceleration only


def test_map_at_home_is_that_of_the_machine(atlas):
    still = small_study(link__damping_ratio=0.0, drive__kd=0.0)
    found = workspace.natural_modes_at(still, [still.motion.waypoints[0]])
    np.testing.assert_allclose(found.frequency[0], machine_modes(still).frequency, rtol=1e-8)
    np.testing.assert_allclose(found.share.sum(axis=-1), 1.0, rtol=1e-9)
    # three-fold symmetry: the bending mode with all links in step shares evenly
    even = np.argmin(np.ptp(found.share[0, 3:6, :3], axis=1)) + 3
    np.testing.assert_allclose(found.share[0, even, :3], found.share[0, even, 0], rtol=1e-4)
    np.testing.assert_allclose(found.coupling[0], found.coupling[0, 0], rtol=1e-6)

    chart = atlas[1].map
    assert 0 < np.isfinite(chart.margin).mean() < 1
    assert np.all(np.isfinite(chart.bending) == np.isfinite(chart.margin)[..., None])
    inside = chart.bending[np.isfinite(chart.bending)]
    assert inside.min() > 110 and inside.max() < 125


def test_modes_of_links_that_lengthen_are_drawn_by_their_bending():
    """Elongations come last and are left out: what is drawn is as of links that keep their length.

    Three longitudinal modes come beside those of bending.
    """
    kept = small_study()
    long = kept.change(link__stretch=True)
    modes = [workspace.natural_modes_at(study, np.array([HOME])) for study in (kept, long)]
    shape = modes[1].shape[0, :, 3].real
    by_link = shape[3:].reshape(3, -1)
    assert by_link.shape[1] == kept.link.modes + 1
    bending = np.concatenate([shape[:3], by_link[:, :-1].ravel()])
    one, other = (
        drawing.mode_skeleton(study, np.array(HOME), x)
        for study, x in ((kept, bending), (long, shape))
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    assert modes[1].frequency.shape[1] == modes[0].frequency.shape[1] + 3
    share = modes[1].order_share[0, :, -1]
    assert np.sum(share > 0.5) == 3


def test_a_pose_out_of_reach_is_refused():
    with pytest.raises(StudyError, match="pose = .*gamma is inside"):
        workspace.natural_modes_at(small_study(), [(0.2, 0.0, 0.5)])


def test_the_squared_margin_falls_below_zero_out_of_reach():
    empty = workspace.Map(*[np.zeros(0)] * len(dataclasses.fields(workspace.Map)))
    lift = np.sin([[0.2, 0.7, 0.7], [1.4, 0.7, 0.7], [-0.2, 0.7, 0.7], [0.7, 0.7, 0.7]])
    lift[3, 1] = 1.5
    wanted = [0.2**2, (np.pi / 2 - 1.4) ** 2, -(0.2**2), -1.0]
    np.testing.assert_allclose(empty.replace(lift=lift).squared_margin, wanted, rtol=1e-9)


def test_the_map_of_interactions_is_in_per_cent():
    image = plots.interaction_map(np.array([[0.0, -0.05], [-0.05, 0.0]]), ["a", "b"], 0.2)
    np.testing.assert_allclose(image.get_array(), [[0.0, -5.0], [-5.0, 0.0]])
    assert image.get_clim() == (-20.0, 20.0)


def made_up(link, platform):
    """Subsets of one controlled mode with given residuals of 8 choices."""
    pose = np.stack([platform, 0 * platform, 0 * platform], axis=-1)
    return subsets.Subsets(
        setting=((0.1, "ei"),),
        status=np.zeros((1, 8), int),
        station=link[None, ..., None],
        pose=pose[None],
        peak=link[None, ..., None] ** 2,
        settling=link[None],
        voltage=link[None],
    )


def test_claims_are_counted():
    on = (np.arange(8)[:, None] >> np.arange(3)) & 1
    link = 1.0 - 0.5 * on
    platform = np.array([1.0, 0.8, 0.8, 0.4, 0.8, 0.45, 0.6, 0.7])  # three worse than two
    seen = made_up(link, platform)
    steps = claims.one_more_link(seen)
    assert steps.rises[0].tolist() == [0, 0, 0, 0, 3]
    assert np.argmax(steps.change[0, 4]) == steps.labels.index("1+2 -> 1+2+3")
    np.testing.assert_allclose(claims.two_links(seen).change[0], [-0.6, -0.55, -0.4])
    signs = claims.table_1_signs(seen.each(lambda values: values[:, None]))
    assert np.all(signs.agree[:, signs.is_controlled])
    np.testing.assert_allclose(signs.ours[0][signs.is_controlled], -0.75)
    np.testing.assert_allclose(signs.ours[0][~signs.is_controlled], 0.0)


def test_a_report_says_what_control_of_all_links_changes():
    """From no control to that of all, the last of the choices."""
    vibration = np.ones((2, 4, 5, 3))
    vibration[0, -1], vibration[1, -1] = (0.8, 0.8, 0.7), (1.1, 1.1, 1.0)
    runs = platform.PlatformError(
        time=np.arange(5.0),
        command_end=np.zeros(2),
        window=np.ones((2, 5)),
        drive=np.stack([np.full((5, 3), 0.5), np.full((5, 3), 2.0)]),
        vibration=vibration,
        pose=vibration,
        modal=vibration[..., None],
    )
    texts = _errors(mock.Mock(platform=runs)).parts[2].texts
    assert [text.rpartition(" by ")[2] for text in texts] == [
        "-20.0 % (φ: -30.0 %)",
        "+10.0 % (φ: 0.0 %)",
    ]
    assert ["the drive error is the larger" in text for text in texts] == [False, True]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"control__feedback": "ideal"}, "control.feedback = 'ideal'; allowed: 'sampled'"),
        ({"control__law": "srf"}, "control.law = 'srf'; allowed: 'imsc'"),
        ({"motion__waypoints": ((0.0, 0.0, 0.5),)}, "motion.waypoints"),
        ({"control__gain_factor": 0.0}, "control.gain_factor = 0.0; allowed: gains that do"),
    ],
)
def test_designs_without_subsets_are_refused(tmp_path, fields, message):
    with pytest.raises(StudyError, match=message):
        atlas_of(small_study(**fields), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_machines_of_two_links_are_refused(tmp_path, capsys):
    said = refused(capsys, "atlas", "five_bar", "--out", tmp_path / "out")
    assert "machine.kind = 'five_bar'; allowed: prrr, rrr: machines of 3 links" in said
    assert not (tmp_path / "out").exists()


def test_settings_with_failed_runs_are_left_out_in_words():
    seen = made_up(np.ones((8, 3)), np.ones(8))
    twice = seen.each(lambda values: np.concatenate([values] * 2))
    twice = twice._replace(setting=(*seen.setting, (0.03, "none")))
    twice.status[1, 3] = 1
    kept, dropped = run.sound_settings(twice)
    assert kept.setting == seen.setting and kept.station.shape[0] == 1
    assert dropped[0].startswith("0.03 s, no shaper: runs with ")
    twice.status[:] = 1
    assert run.sound_settings(twice)[0].setting == ()


def test_atlas_leaves_a_folder_of_something_else_alone(tmp_path):
    mine = tmp_path / "report.html"
    mine.write_text("mine")
    with pytest.raises(StudyError, match="holds other files"):
        atlas_of(small_study(), tmp_path)
    assert mine.read_text() == "mine"


def test_a_resumed_analysis_repeats_nothing(atlas):
    folder, found = atlas
    nothing = dict.fromkeys(("platform_error", "responses", "map_workspace"))
    with mock.patch.multiple(findings, **nothing):
        again = findings.evaluate_atlas(
            found.study, found.choices, found.subsets, list(found.dropped), quiet_job(folder)
        )
    data, wanted = run.atlas_variables(again), run.atlas_variables(found)
    for name, variable in wanted.items():
        np.testing.assert_array_equal(data[name].data, variable.data, err_msg=name)


def test_atlas_goes_on_after_an_interrupt_and_refuses_to_start_over(atlas, tmp_path):
    folder = atlas[0]
    assert read_sweep(folder / run.RUNS_FOLDER).is_finished.all()
    with pytest.raises(StudyError, match="add --resume"):
        atlas_of(small_study(), folder)
    assert Path(folder / "report.html").is_file()


@pytest.mark.long  # in short: an interrupted screen, in test_screen
def test_an_interrupted_drawing_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "mapped", stop)
    code, _, err = command(capsys, "atlas", "--out", tmp_path / "out")
    assert code == 130 and f"continue with: studies atlas --out {tmp_path / 'out'} --resume" in err
