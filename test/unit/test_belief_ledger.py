"""Truth of Gaussians by a hand-made wall and box; the ledger by a scripted map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import RgbdFrame, TrackingResult, TrackingStatus
from bdgs_ros.eval.belief_ledger import BeliefLedger
from bdgs_ros.eval.belief_score import BeliefScore
from bdgs_ros.eval.gaussian_truth import TrueState, project, sight, true_states
from bdgs_ros.eval.restoration import Restorations

CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)
WALL_M, BOX_M, WALKER_M = 3.0, 2.0, 1.0
LEFT = np.s_[:, :20]
ON_WALL, ON_BOX = (0.5, 0.0, WALL_M), (-0.5, 0.0, BOX_M)
KEYFRAME_NS = 400_000_000


def depth(z: float, left: float | None = None) -> np.ndarray:
    image = np.full(CAMERA.shape, z, np.float32)
    if left is not None:
        image[LEFT] = left
    return image


def states_of(*points: tuple[float, float, float], static: np.ndarray) -> list[int]:
    at = project(np.array(points, np.float32), np.eye(4), CAMERA)
    return true_states(at, static).tolist()


def test_projection_is_to_the_nearest_pixel_and_knows_what_is_outside() -> None:
    means = np.array([[0, 0, 1], [0.4875, 0, 1], [0.6, 0, 1], [0, 0, -1]], np.float32)
    at = project(means, np.eye(4), CAMERA)
    assert at.inside.tolist() == [True, True, False, False]
    assert (at.column[1], at.row[1]) == (39, 14)
    moved = np.eye(4)
    moved[0, 3] = 0.6
    assert project(means[2:3], moved, CAMERA).column[0] == 20


@pytest.mark.parametrize(
    ('off_m', 'state'),
    [
        (0.0, TrueState.STATIC),
        (0.07, TrueState.STATIC),  # within 3 cm + 0.5 cm * 9
        (-0.07, TrueState.STATIC),
        (-0.10, TrueState.UNKNOWN),  # too near to tell
        (-0.14, TrueState.DYNAMIC),  # beyond 4 cm + 1 cm * 9
        (-1.5, TrueState.DYNAMIC),
        (0.5, TrueState.UNKNOWN),  # behind the wall
    ],
)
def test_states_by_the_distance_from_a_wall(off_m: float, state: TrueState) -> None:
    assert states_of((0.0, 0.0, WALL_M + off_m), static=depth(WALL_M)) == [state]


def test_a_box_at_rest_is_static_and_its_place_is_not_once_it_left() -> None:
    assert states_of(ON_BOX, ON_WALL, static=depth(WALL_M, BOX_M)) == [TrueState.STATIC] * 2
    assert states_of(ON_BOX, ON_WALL, static=depth(WALL_M)) == [
        TrueState.DYNAMIC,
        TrueState.STATIC,
    ]


def test_between_the_surfaces_of_an_edge_nothing_is_known() -> None:
    static = depth(WALL_M, BOX_M)
    x = (19.5 - CAMERA.cx) / CAMERA.fx  # on the edge: both surfaces are within reach
    at_edge = [(x * z, 0.0, z) for z in (BOX_M, 2.5, WALL_M, 1.0)]
    assert states_of(*at_edge, static=static) == [
        TrueState.STATIC,
        TrueState.UNKNOWN,
        TrueState.STATIC,
        TrueState.DYNAMIC,
    ]


def test_without_depth_or_outside_nothing_is_known() -> None:
    assert states_of((0, 0, 1.0), static=depth(0.0)) == [TrueState.UNKNOWN]
    assert states_of((9, 0, 1.0), static=depth(WALL_M)) == [TrueState.UNKNOWN]


def test_sight_tells_hidden_met_and_seen_through() -> None:
    at = project(np.array([ON_WALL, ON_BOX, (0.3, 0, 1.0)], np.float32), np.eye(4), CAMERA)
    seen = sight(at, depth(WALL_M, left=WALKER_M))
    assert seen.visible.tolist() == [True, False, True]
    assert seen.met.tolist() == [True, False, False]
    assert not sight(at, depth(0.0)).visible.any()


@dataclass
class ScriptedMap:
    """A map whose content the test sets by hand before each keyframe."""

    serial: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    means: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    shown: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def visible_mask(self) -> np.ndarray:
        return self.shown


@dataclass
class Render:
    depth: np.ndarray
    silhouette: np.ndarray


@dataclass
class ScriptedMapper:
    """Renders the wall: all of it, and without what is hidden `shown_share` of it."""

    map: ScriptedMap = field(default_factory=ScriptedMap)
    removed_by_belief: tuple[int, ...] = ()
    shown_share: float = 1.0

    def final_pose(self, stamp_ns: int, T_world_camera: np.ndarray) -> np.ndarray:
        return T_world_camera

    def render_everything(self, T_world_camera: np.ndarray, camera: PinholeCamera) -> Render:
        ones = np.ones(camera.shape, np.float32)
        return Render(WALL_M * ones, ones)

    def render(self, T_world_camera: np.ndarray, camera: PinholeCamera) -> Render:
        silhouette = np.zeros(camera.shape, np.float32)
        silhouette[: round(self.shown_share * camera.height)] = 1
        return Render(WALL_M * silhouette, silhouette)


class Scene:
    """A wall; a box before its left half rests, moves or is gone; a ledger that watches."""

    def __init__(self, things: tuple[int, ...] = ()) -> None:
        self.mapper = ScriptedMapper()
        self.box = 'rests'
        self.walker = False
        self.stamp_ns = 0
        self.ledger = BeliefLedger(self.mapper, self, things)

    def static_depth(self, stamp_ns: int) -> np.ndarray:
        return depth(WALL_M, BOX_M if self.box == 'rests' else None)

    def dynamic(self, stamp_ns: int) -> np.ndarray:
        mask = np.zeros(CAMERA.shape, bool)
        mask[LEFT] = self.walker or self.box == 'moves'
        return mask

    def object_id(self, stamp_ns: int) -> np.ndarray:
        image = np.ones(CAMERA.shape, np.uint8)
        image[LEFT] = 9 if self.walker else 1 if self.box == 'gone' else 7
        return image

    def keyframe(self, **gaussians: tuple[tuple[float, float, float], bool]) -> BeliefScore:
        """Show the ledger a keyframe with Gaussians by name g0, g1, ...: where, rendered."""
        self.mapper.map.serial = np.array([int(name[1:]) for name in gaussians], np.int64)
        means = np.array([where for where, _ in gaussians.values()], np.float32)
        self.mapper.map.means = means.reshape(-1, 3)
        self.mapper.map.shown = np.array([shown for _, shown in gaussians.values()], bool)
        left = WALKER_M if self.walker else None if self.box == 'gone' else BOX_M
        color = np.zeros((*CAMERA.shape, 3), np.uint8)
        frame = RgbdFrame(self.stamp_ns, color, depth(WALL_M, left), CAMERA)
        none = np.zeros(CAMERA.shape, np.uint8)
        ok = TrackingStatus.OK
        self.ledger(frame, TrackingResult(self.stamp_ns, ok, np.eye(4), np.eye(6), True, none))
        self.stamp_ns += KEYFRAME_NS
        self.mapper.removed_by_belief = ()
        return self.ledger.score()


def test_a_gaussian_is_judged_once_after_three_keyframes_of_evidence() -> None:
    scene = Scene()
    for _ in range(3):  # the first is that of its birth
        score = scene.keyframe(g0=(ON_WALL, True), g1=(ON_WALL, False))
        assert score.true_negatives == score.false_positives == 0
    for _ in range(3):
        score = scene.keyframe(g0=(ON_WALL, True), g1=(ON_WALL, False))
        assert (score.true_negatives, score.false_positives) == (1, 1)
    assert (score.true_positives, score.false_negatives) == (0, 0)


def test_hidden_behind_a_walker_there_is_no_evidence() -> None:
    scene = Scene()
    scene.keyframe(g0=(ON_BOX, True))
    scene.walker = True
    for _ in range(5):
        score = scene.keyframe(g0=(ON_BOX, True))
    assert score.true_negatives == 0
    scene.walker = False
    for _ in range(3):
        score = scene.keyframe(g0=(ON_BOX, True))
    assert score.true_negatives == 1


def test_truth_that_changes_starts_a_new_account() -> None:
    scene = Scene(things=(7,))
    for _ in range(4):
        scene.keyframe(g0=(ON_BOX, True), g1=(ON_BOX, True))
    scene.box = 'gone'
    for _ in range(2):
        score = scene.keyframe(g0=(ON_BOX, False), g1=(ON_BOX, True))
        assert score.true_positives == 0
    score = scene.keyframe(g0=(ON_BOX, False), g1=(ON_BOX, True))
    assert (score.true_positives, score.false_negatives) == (1, 1)
    assert (score.thing_positives, score.thing_negatives) == (1, 1)
    assert score.true_negatives == 2
    assert score.unknown_recall == score.recall == 0.5


def test_what_belief_deletes_early_is_judged_and_what_housekeeping_deletes_is_not() -> None:
    scene = Scene()
    scene.keyframe(g0=(ON_BOX, True), g1=(ON_WALL, True), g2=(ON_BOX, True), g3=(ON_WALL, True))
    scene.box = 'gone'
    scene.mapper.removed_by_belief = (0, 1)
    score = scene.keyframe(g3=(ON_WALL, True))
    assert (score.true_positives, score.false_positives) == (1, 1)
    assert (score.statics, score.statics_removed) == (2, 1)
    assert score.false_removal == 0.5


def test_at_the_end_hidden_statics_count_as_removed() -> None:
    scene = Scene()
    score = scene.keyframe(g0=(ON_WALL, False), g1=(ON_WALL, True), g2=(ON_BOX, True))
    assert (score.statics, score.statics_removed) == (3, 1)
    scene.box = 'gone'
    score = scene.keyframe(g0=(ON_WALL, True), g1=(ON_WALL, True), g2=(ON_BOX, False))
    assert (score.statics, score.statics_removed) == (2, 0)


def test_born_on_a_mover_close_to_a_wall_nobody_can_tell() -> None:
    scene = Scene()
    scene.box = 'moves'
    scene.static_depth = lambda stamp_ns: depth(WALL_M, BOX_M + 0.03)  # type: ignore[method-assign]
    for _ in range(5):
        score = scene.keyframe(g0=(ON_BOX, False), g1=(ON_WALL, True))
    assert score.false_positives == 0
    assert score.statics == 1


def test_a_static_hidden_once_is_restored_within_a_second_of_being_seen() -> None:
    scene = Scene()
    scene.keyframe(g0=(ON_BOX, True), g1=(ON_BOX, True), g2=(ON_BOX, False))
    scene.walker = True
    scene.keyframe(g0=(ON_BOX, False), g1=(ON_BOX, False), g2=(ON_BOX, False))
    scene.walker = False
    hidden = {'g1': (ON_BOX, False)}
    scene.keyframe(g0=(ON_BOX, False), **hidden, g2=(ON_BOX, False))
    score = scene.keyframe(g0=(ON_BOX, True), **hidden, g2=(ON_BOX, True))
    assert (score.restored, score.not_restored, score.settled) == (1, 0, 0)
    scene.keyframe(g0=(ON_BOX, True), **hidden)
    score = scene.keyframe(g0=(ON_BOX, True), **hidden)
    assert (score.restored, score.not_restored) == (1, 1)
    assert score.restored_share == 0.5


def test_the_hidden_share_of_static_pixels_is_noted() -> None:
    scene = Scene()
    scene.box = 'gone'
    scene.mapper.shown_share = 0.8
    scene.keyframe(g0=(ON_WALL, True))
    assert scene.ledger.metrics()[-1].value == pytest.approx(20.0, abs=0.5)


def note(waits: Restorations, at_s: float, static: bool, seen: bool, shown: bool) -> None:
    zero = np.zeros(1, np.int64)
    waits.note(round(at_s * 1e9), zero, *(np.array([x]) for x in (static, seen, shown)))


def counted(waits: Restorations) -> dict[str, int]:
    return {name: count for name, count in waits.counts.items() if count}


@pytest.mark.parametrize(
    ('then', 'expected'),
    [
        ([(0.5, True, True, True)], {'settled': 1}),
        ([(1.0, True, True, True)], {'settled': 1}),
        ([(1.2, True, True, True)], {'not_settled': 1}),
        ([(0.5, True, True, False), (1.1, True, True, False)], {'not_settled': 1}),
        ([(0.5, False, True, False)], {'unresolved': 1}),
        (
            [(t, True, False, False) for t in (0.3, 0.6, 0.9, 1.2)],
            {'unresolved': 1},
        ),
        ([(0.5, True, True, False)], {}),
    ],
)
def test_how_a_wait_ends(
    then: list[tuple[float, bool, bool, bool]], expected: dict[str, int]
) -> None:
    waits = Restorations()
    note(waits, 0.0, True, True, False)
    assert waits.open_waits() == 1
    for moment in then:
        note(waits, *moment)
    assert counted(waits) == expected
    assert waits.open_waits() == (0 if expected else 1)


def test_a_failure_is_counted_once_until_it_was_unseen_for_long_or_shown() -> None:
    waits = Restorations()
    for at_s in (0.0, 0.5, 1.1, 1.6, 2.0, 2.5, 3.0):
        note(waits, at_s, True, True, False)
    assert counted(waits) == {'not_settled': 1}
    note(waits, 4.5, True, True, False)  # seen again after a second and a half
    note(waits, 5.0, True, True, True)
    assert counted(waits) == {'not_settled': 1, 'settled': 1}
    note(waits, 5.5, True, True, False)  # hidden while it is looked at
    note(waits, 6.0, True, True, True)
    assert counted(waits) == {'not_settled': 1, 'settled': 1, 'restored': 1}


def test_deletion_ends_a_wait() -> None:
    serial = np.arange(2)
    yes, no = np.ones(2, bool), np.zeros(2, bool)
    waits = Restorations()
    waits.note(0, serial, yes, yes, no)
    waits.deleted(serial[:1], serial[1:])
    assert counted(waits) == {'not_settled': 1, 'unresolved': 1}


def test_scores_pool_and_survive_a_row() -> None:
    a = BeliefScore(true_positives=3, false_negatives=1, false_positives=1, statics=10)
    b = BeliefScore(true_positives=1, false_negatives=3, statics_removed=1)
    both = a + BeliefScore.of({**b.counts(), 'other': 'x', 'settled': None})
    assert both.recall == 0.5
    assert both.precision == 0.8
    assert both.false_removal == 0.1
    assert np.isnan(BeliefScore(false_positives=5).precision)
