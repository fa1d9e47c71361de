"""Rates, delays and sentences: each fault is played with the test's own clock and must be named."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.health.diagnosis import Diagnosis, MapSizes
from fus3dmaps_core.health.input_problems import Level, Offer, stamp_difference, unheard
from fus3dmaps_core.health.mapping_problems import Latency, MemoryState
from fus3dmaps_core.sources.streams import Qos, Stream

SECOND_NS = 10**9
START_NS = 1_700_000_000 * SECOND_NS
NO_SIZES = MapSizes(0, 0, {})


def stream(topic: str, role: str, profile: str = "reliable") -> Stream:
    return Stream(topic, role, "any/msg/Type", f"input.{role}_topic", profile, lambda message: None)


RGB, DEPTH, POSE = stream("rgb/image", "rgb"), stream("depth/image", "depth"), stream("pose", "pose")
INFO = stream("rgb/camera_info", "camera_info")


class Bench:
    """A diagnosis of one camera with a clock set by the test; stamps are the node's time unless changed."""

    def __init__(self, *streams: Stream, **options) -> None:
        self.now_s = 100.0
        options = {"sync_tolerance_s": 0.02, "max_wait_s": 2.0, **options}
        self.diagnosis = Diagnosis(streams or (RGB, DEPTH, POSE, INFO), clock=lambda: self.now_s, **options)

    @property
    def now_ns(self) -> int:
        return START_NS + round(self.now_s * SECOND_NS)

    def play(self, seconds: float, *topics: str, period_s: float = 0.1, **offsets_s: float) -> None:
        """Play messages of every topic at a period; ``offsets_s`` (by role) are added to their stamps."""
        roles = {RGB.topic: "rgb", DEPTH.topic: "depth", POSE.topic: "pose", INFO.topic: "info"}
        for _ in range(round(seconds / period_s)):
            self.now_s += period_s
            for topic in topics or roles:
                offset_ns = round(offsets_s.get(roles[topic], 0.0) * SECOND_NS)
                self.diagnosis.arrived(topic, self.now_ns + offset_ns, self.now_ns)

    def found(self, *args, **kwargs) -> dict[str, str]:
        """Return the sentences by kind."""
        return {problem.kind: problem.sentence for problem in self.diagnosis.problems(*args, **kwargs)}


def test_a_healthy_camera_has_no_problem() -> None:
    bench = Bench()
    bench.play(20.0)
    assert (
        bench.diagnosis.problems({topic: [Offer("/driver", "RELIABLE", "VOLATILE")] for topic in bench.diagnosis.rates_hz()})
        == []
    )


def test_rates_are_those_of_the_window_and_honest_before_it_is_full() -> None:
    bench = Bench()
    bench.play(2.0, RGB.topic, period_s=0.1)
    assert bench.diagnosis.rates_hz() == {RGB.topic: pytest.approx(10.0), DEPTH.topic: 0.0, POSE.topic: 0.0, INFO.topic: 0.0}
    bench.play(10.0, RGB.topic, period_s=0.5)
    assert bench.diagnosis.rates_hz()[RGB.topic] == pytest.approx(2.0)
    bench.now_s += 10.0
    assert bench.diagnosis.rates_hz()[RGB.topic] == 0.0


def test_latency_is_mean_and_maximum_per_stage_in_the_window() -> None:
    bench = Bench()
    bench.diagnosis.finished({"patch": 9.0}, waiting=0)
    bench.now_s += 10.0
    bench.diagnosis.finished({"patch": 0.1, "crop": 0.5}, waiting=0)
    bench.diagnosis.finished({"patch": 0.3}, waiting=0)
    assert bench.diagnosis.latencies() == {"patch": Latency(2, pytest.approx(0.2), 0.3), "crop": Latency(1, 0.5, 0.5)}


def test_silence_names_the_topic_and_how_long() -> None:
    bench = Bench()
    bench.play(10.0, RGB.topic, POSE.topic, INFO.topic)
    assert bench.found() == {"silence": "no message on depth/image for 10 s"}


def test_a_topic_that_falls_silent_is_named_and_forgiven_when_it_speaks_again() -> None:
    bench = Bench()
    bench.play(3.0)
    bench.play(4.9, RGB.topic, DEPTH.topic)
    assert "silence" not in bench.found()
    bench.play(0.2, RGB.topic, DEPTH.topic)
    assert bench.found()["silence"] == "no message on pose for 5 s"
    bench.play(0.1)
    assert bench.found() == {}


def test_a_latched_camera_model_may_come_once() -> None:
    bench = Bench()
    bench.play(0.1, INFO.topic)
    bench.play(60.0, RGB.topic, DEPTH.topic, POSE.topic)
    assert bench.found() == {}


@pytest.mark.parametrize(
    ("profile", "offer", "kind", "sentence"),
    [
        ("reliable", None, "no_publisher", "it has no publisher"),
        (
            "reliable",
            Offer("/cam", "BEST_EFFORT", "VOLATILE"),
            "qos_mismatch",
            "no message on depth/image for 5 s; its publisher offers BEST_EFFORT, we ask RELIABLE: set parameter"
            " 'input.depth_qos'",
        ),
        (
            "transient_local",
            Offer("/cam", "BEST_EFFORT", "VOLATILE"),
            "qos_mismatch",
            "offers BEST_EFFORT, we ask RELIABLE and offers VOLATILE, we ask TRANSIENT_LOCAL",
        ),
        (
            "sensor_data",
            Offer("/cam", "RELIABLE", "TRANSIENT_LOCAL"),
            "silence",
            "has 1 publisher (/cam) whose QoS",
        ),
    ],
)
def test_silence_is_explained_by_the_publishers(profile, offer, kind, sentence) -> None:
    bench = Bench(stream("depth/image", "depth", profile))
    bench.now_s += 5.0
    found = bench.found({"depth/image": [] if offer is None else [offer]})
    assert list(found) == [kind]
    assert sentence in found[kind]


def test_a_second_publisher_that_is_not_heard_is_named() -> None:
    bench = Bench(RGB)
    bench.play(1.0, RGB.topic)
    offers = {RGB.topic: [Offer("/front", "RELIABLE", "VOLATILE"), Offer("/rear", "BEST_EFFORT", "VOLATILE")]}
    assert "1 of 2 publishers of rgb/image are not heard; /rear offers BEST_EFFORT" in bench.found(offers)["qos_mismatch"]


@given(
    asked=st.tuples(
        st.sampled_from(["RELIABLE", "BEST_EFFORT", "BEST_AVAILABLE"]),
        st.sampled_from(["TRANSIENT_LOCAL", "VOLATILE", "BEST_AVAILABLE"]),
    ),
    offered=st.tuples(st.sampled_from(["RELIABLE", "BEST_EFFORT"]), st.sampled_from(["TRANSIENT_LOCAL", "VOLATILE"])),
)
def test_qos_matches_where_the_offer_is_at_least_what_is_asked(asked, offered) -> None:
    rank = {"BEST_AVAILABLE": 0, "BEST_EFFORT": 0, "VOLATILE": 0, "RELIABLE": 1, "TRANSIENT_LOCAL": 1}
    matches = all(rank[offer] >= rank[ask] for ask, offer in zip(asked, offered, strict=True))
    assert (unheard(Qos(*asked), Offer("/b", *offered)) == "") == matches


def test_depth_beside_colour_in_time_is_told_with_the_tolerance_that_would_do() -> None:
    bench = Bench()
    bench.play(10.0, period_s=0.2, depth=-0.08)
    found = bench.found()
    assert list(found) == ["stamp_difference"]
    assert "stamps of depth/image and rgb/image differ by 80 ms" in found["stamp_difference"]
    assert "set it to 0.08 s" in found["stamp_difference"]
    allowed = Bench(sync_tolerance_s=0.08)
    allowed.play(10.0, period_s=0.2, depth=-0.08)
    assert allowed.found() == {}


@pytest.mark.parametrize("behind_s", [7.0, 900.0])
def test_depth_of_another_clock_is_not_blamed_on_the_tolerance(behind_s) -> None:
    bench = Bench(clock_tolerance_s=1000.0)
    bench.play(30.0, depth=-behind_s)
    found = bench.found()
    assert list(found) == ["depth_lag"]
    assert f"depth images on depth/image end {behind_s:.1f} s before images on rgb/image" in found["depth_lag"]


def test_depth_is_compared_with_the_colour_of_its_own_camera() -> None:
    names = ("front", "rear")
    streams = [stream(f"{name}/{role}", role) for role in ("rgb", "depth") for name in names]
    bench = Bench(*streams)
    for _ in range(100):
        bench.now_s += 0.2
        for name, late_s in (("front", 0.0), ("rear", 0.09)):
            for role in ("rgb", "depth") if name == "rear" else ("rgb",):
                stamp_ns = bench.now_ns - round(late_s * SECOND_NS)
                bench.diagnosis.arrived(f"{name}/{role}", stamp_ns, bench.now_ns)
    assert list(bench.found()) == ["silence"]


def test_slower_depth_whose_stamps_are_those_of_colour_is_fine() -> None:
    bench = Bench()
    for index in range(300):
        bench.play(1 / 30, RGB.topic, *([DEPTH.topic] if index % 6 == 0 else []), POSE.topic, INFO.topic, period_s=1 / 30)
    assert bench.found() == {}


@given(offset_ms=st.integers(-300, 300), jitter=st.lists(st.integers(-2, 2), min_size=40, max_size=40))
def test_the_difference_is_the_median_to_the_nearest(offset_ms, jitter) -> None:
    rgb_ns = [START_NS + index * SECOND_NS for index in range(40)]
    depth_ns = [at + (offset_ms + shake) * 10**6 for at, shake in zip(rgb_ns, jitter, strict=True)]
    problem = stamp_difference(RGB, DEPTH, rgb_ns, depth_ns, 0.02)
    if abs(offset_ms) <= 18:
        assert problem is None
    elif abs(offset_ms) >= 23:
        assert problem is not None
        told_ms = float(problem.sentence.partition(" differ by ")[2].partition(" ms")[0])
        assert abs(told_ms - abs(offset_ms)) <= 2


def test_poses_that_lag_and_images_that_lag() -> None:
    bench = Bench()
    bench.play(3.0, pose=-2.1)
    problems = {problem.kind: problem for problem in bench.diagnosis.problems()}
    assert list(problems) == ["pose_lag"]
    assert "poses on pose end 2.1 s before images on rgb/image" in problems["pose_lag"].sentence
    assert problems["pose_lag"].level == Level.ERROR
    slight = Bench()
    slight.play(3.0, pose=-1.5)
    assert [problem.level for problem in slight.diagnosis.problems()] == [Level.WARN]
    patient = Bench(max_wait_s=5.0)
    patient.play(3.0, pose=-2.1)
    assert patient.found() == {}
    late = Bench()
    late.play(3.0, rgb=-3.0, depth=-3.0)
    assert "images on rgb/image end 3.0 s before poses on pose" in late.found()["image_lag"]


@pytest.mark.parametrize(("use_sim_time", "hint"), [(False, "set use_sim_time for a recording"), (True, "does /clock come")])
def test_stamps_of_another_day(use_sim_time, hint) -> None:
    bench = Bench(use_sim_time=use_sim_time)
    bench.play(3.0, rgb=-3600.0, depth=-3600.0, pose=-3600.0)
    found = bench.found()
    assert list(found) == ["clock_mismatch"]
    assert "rgb/image 3600.0 s behind, depth/image 3600.0 s behind, pose 3600.0 s behind it" in found["clock_mismatch"]
    assert hint in found["clock_mismatch"]


def test_a_late_but_honest_sensor_is_no_clock_mismatch() -> None:
    bench = Bench()
    bench.play(3.0, rgb=-0.5, depth=-0.5, pose=-0.5)
    assert bench.found() == {}


@pytest.mark.parametrize(
    ("intrinsics", "symptom"),
    [
        (Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480), ""),
        (Intrinsics(100.0, 525.0, 319.5, 239.5, 640, 480), "fx is 100 px"),
        (Intrinsics(525.0, 4000.0, 319.5, 239.5, 640, 480), "fy is 4000 px"),
        (Intrinsics(525.0, 525.0, 639.5, 239.5, 640, 480), "cx is 640 px, outside the middle half of 640 px"),
        (Intrinsics(525.0, 525.0, 319.5, 100.0, 640, 480), "cy is 100 px"),
    ],
)
def test_camera_models_that_do_not_fit_their_image(intrinsics, symptom) -> None:
    bench = Bench()
    bench.play(1.0)
    bench.diagnosis.camera(INFO.topic, intrinsics)
    found = bench.found()
    assert list(found) == (["unlikely_intrinsics"] if symptom else [])
    assert symptom in found.get("unlikely_intrinsics", "")
    bench.diagnosis.camera(INFO.topic, Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480))
    assert bench.found() == {}


def see(bench: Bench, T: np.ndarray, depth_m: np.ndarray, encoding: str = "32FC1") -> None:
    bench.diagnosis.frame(T, depth_m.astype(np.float32), depth_topic=DEPTH.topic, encoding=encoding, pose_topic=POSE.topic)


@pytest.mark.parametrize(
    ("encoding", "depth_m", "sentence"),
    [
        ("16UC1", 2.0, ""),
        ("16UC1", 0.003, "looks like metres or centimetres, not millimetres: half of its 16UC1 readings are below 3 mm"),
        ("32FC1", 2.0, ""),
        ("32FC1", 0.003, ""),
        ("32FC1", 2000.0, "looks like millimetres, not metres: half of its 32FC1 readings are beyond 2000 m"),
    ],
)
def test_depth_in_another_unit(encoding, depth_m, sentence) -> None:
    bench = Bench()
    bench.play(1.0)
    image = np.full((48, 64), depth_m)
    image[:, :20] = 0.0
    image[:, 20:30] = np.nan
    image[:, 30] = np.inf
    see(bench, np.eye(4), image, encoding)
    found = bench.found()
    assert list(found) == (["unlikely_depth"] if sentence else [])
    assert sentence in found.get("unlikely_depth", "")


def test_an_image_without_readings_says_nothing() -> None:
    bench = Bench()
    bench.play(1.0)
    for _ in range(30):
        see(bench, np.eye(4), np.zeros((48, 64)))
    assert bench.found() == {}


OPTICAL_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FLOOR = np.broadcast_to(np.linspace(4.0, 0.8, 48)[:, None], (48, 64))
CEILING = np.full((48, 64), 1.9)


def pose(yaw: float, tilt: float = 0.0, optical: bool = False) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZY", [yaw, tilt]).as_matrix() @ (OPTICAL_IN_BODY if optical else np.eye(3))
    return T


def drive(poses: list[np.ndarray], depth_m: np.ndarray) -> dict[str, str]:
    bench = Bench()
    bench.play(1.0)
    for T in poses:
        see(bench, T, depth_m)
    return bench.found()


HEADINGS = np.linspace(0.0, 2.0, 40)


def test_poses_of_a_body_frame_are_doubted() -> None:
    found = drive([pose(yaw, tilt=0.1) for yaw in HEADINGS], FLOOR)
    assert "camera looks along x, not z: is this an optical frame?" in found["not_optical"]
    assert "input.T_body_camera" in found["not_optical"]


@pytest.mark.parametrize(
    ("poses", "depth_m"),
    [
        ([pose(yaw, optical=True) for yaw in HEADINGS], FLOOR),
        # Looks straight up, at a ceiling.
        ([pose(yaw) for yaw in HEADINGS], CEILING),
        # The world is the first camera's frame: looks ahead, to the left and right, and nods.
        ([pose(0.0, tilt) for tilt in 0.4 * np.sin(HEADINGS)], FLOOR),
        # Nothing is known before it turns, or from a few poses.
        ([pose(0.3) for _ in HEADINGS], FLOOR),
        ([pose(yaw) for yaw in HEADINGS[::4]], FLOOR),
    ],
)
def test_poses_that_may_be_those_of_a_camera_are_not_doubted(poses, depth_m) -> None:
    assert drive(poses, depth_m) == {}


@given(start=st.floats(-math.pi, math.pi), span=st.floats(0.0, 2.0))
def test_a_turn_counts_from_45_degrees_wherever_it_starts(start, span) -> None:
    found = drive([pose(start + span * share) for share in np.linspace(0.0, 1.0, 25)], FLOOR)
    if abs(span - math.pi / 4) > 1e-6:
        assert ("not_optical" in found) == (span > math.pi / 4)


def test_drops_are_told_with_reason_and_latest_sentence_while_they_last() -> None:
    bench = Bench()
    bench.play(10.0)
    bench.diagnosis.dropped("no_pose", "first")
    bench.diagnosis.dropped("no_pose", "rgb/image: image at 3 has no pose", 4)
    assert bench.found() == {"dropped": "dropped 5 in 10 s (no_pose): rgb/image: image at 3 has no pose"}
    bench.play(10.1)
    assert bench.found() == {}
    assert bench.diagnosis.drops() == {"no_pose": 5}


def test_a_full_queue_says_how_much_is_lost_and_to_which_stage() -> None:
    bench = Bench()
    for index in range(50):
        bench.play(0.2)
        bench.diagnosis.offered(waiting=4)
        if index % 5 == 0:
            bench.diagnosis.finished({"patch": 0.2, "crop": 0.7}, waiting=3)
        else:
            bench.diagnosis.dropped("queue_full", "unmapped")
    sentence = bench.found()["queue_full"]
    assert "80% of the frames are dropped" in sentence
    assert "5.0 frames/s come, 1.0 keyframes/s are mapped" in sentence
    assert "slowest stage is 'crop' with 700 ms" in sentence
    assert bench.diagnosis.report(NO_SIZES)[1].level == Level.WARN


def test_mapping_at_its_limit_warns_before_frames_are_lost() -> None:
    bench = Bench()
    for _ in range(20):
        bench.play(0.5)
        bench.diagnosis.offered(waiting=1)
        bench.diagnosis.finished({"crop": 0.48}, waiting=0)
    assert "busy 96% of the time" in bench.found()["busy"]


def test_frames_that_wait_and_none_that_ends_is_a_stall() -> None:
    bench = Bench()
    for _ in range(310):
        bench.play(0.1)
        bench.diagnosis.offered(waiting=2)
    assert "finished no frame for 31 s while 2 wait" in bench.found()["stalled"]
    bench.diagnosis.finished({}, waiting=1)
    assert bench.found() == {}


def test_a_pause_without_frames_is_no_stall() -> None:
    bench = Bench()
    bench.diagnosis.offered(waiting=1)
    bench.diagnosis.finished({}, waiting=0)
    bench.play(60.0)
    bench.diagnosis.offered(waiting=1)
    assert bench.found() == {}


def test_memory_near_its_budget() -> None:
    bench = Bench()
    bench.play(1.0)
    states = [MemoryState("host", 89, 100), MemoryState("cuda:0", 95 * 2**20, 100 * 2**20), MemoryState("cuda:1", 9, 0)]
    found = bench.found(memory=states)
    assert list(found) == ["near_budget"]
    assert "memory of cuda:0 is at 95% of its budget of 100 MiB" in found["near_budget"]


def test_the_report_has_a_level_a_line_and_figures_for_each_part() -> None:
    bench = Bench()
    bench.play(10.0, RGB.topic, POSE.topic, INFO.topic)
    bench.diagnosis.offered(waiting=1)
    bench.diagnosis.finished({"crop": 0.25}, waiting=0)
    bench.diagnosis.dropped("no_depth", "rgb/image: no depth", 7)
    reports = {report.part: report for report in bench.diagnosis.report(MapSizes(10, 2, {"dense": 2**20, "hash": 2**19}))}
    assert list(reports) == ["inputs", "mapping", "map", "memory"]
    assert [report.level for report in reports.values()] == [Level.ERROR, Level.OK, Level.OK, Level.OK]
    # The worst comes first.
    assert reports["inputs"].message.startswith("no message on depth/image for 10 s; dropped 7")
    assert reports["inputs"].values["rgb/image (Hz)"] == "10.0"
    assert reports["inputs"].values["dropped no_depth"] == "7"
    assert reports["mapping"].values["crop mean, max (ms)"] == "250.0, 250.0"
    assert reports["map"].message == "10 voxels, 2 instances, 1.5 MiB"
    assert reports["map"].values == {"voxels": "10", "instances": "2", "dense (MiB)": "1.0", "hash (MiB)": "0.5"}


def test_mapping_without_frames_is_stale() -> None:
    bench = Bench()
    bench.play(6.0)
    assert bench.diagnosis.report(NO_SIZES)[1].level == Level.STALE
    bench.diagnosis.offered(waiting=0)
    assert bench.diagnosis.report(NO_SIZES)[1].level == Level.OK
