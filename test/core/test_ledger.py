"""One ledger counts frames, drops and stage times, and tells of drops at once."""

from __future__ import annotations

from fus3dmaps_core.ledger import Drops, FrameCounts, Ledger, StageTime


def test_drops_are_counted_by_reason_with_the_latest_sentence() -> None:
    told: list[tuple[str, str, int]] = []
    drops = Drops(lambda *drop: told.append(drop))
    drops.add("no_depth", "the first")
    drops.add("bad_pose", "NaN", 3)
    drops.add("no_depth", "the second")
    assert list(drops.counts().items()) == [("no_depth", 2), ("bad_pose", 3)]
    assert drops.latest() == {"no_depth": "the second", "bad_pose": "NaN"}
    assert told == [("no_depth", "the first", 1), ("bad_pose", "NaN", 3), ("no_depth", "the second", 1)]


def test_observers_come_and_go() -> None:
    told: list[str] = []

    def observe(reason: str, sentence: str, number: int) -> None:
        told.append(reason)

    drops = Drops()
    drops.tell(observe)
    drops.add("no_depth", "")
    drops.stop_telling(observe)
    drops.stop_telling(observe)
    drops.add("no_pose", "")
    assert told == ["no_depth"]


def test_poured_drops_are_one_addition_a_reason_and_leave_nothing() -> None:
    told: list[tuple[str, str, int]] = []
    source, target = Drops(), Drops(lambda *drop: told.append(drop))
    for number in range(3):
        source.add("no_pose", f"image {number}")
    source.pour_into(target)
    source.pour_into(target)
    assert told == [("no_pose", "image 2", 3)]
    assert not source.counts()
    assert source.latest() == {}


def test_frames_and_stages_are_counted() -> None:
    ledger = Ledger()
    for _ in range(3):
        ledger.add_frame()
    ledger.add_not_keyframe()
    ledger.add_keyframe(True, False, 0, {"decode": 1.0})
    ledger.add_keyframe(True, True, 5, {"decode": 3.0, "fusion": 0.5})
    assert ledger.counts() == FrameCounts(3, 1, 2, 1, 5)
    assert ledger.stages_s() == {"decode": 4.0, "fusion": 0.5}
    assert ledger.stage_times() == {"decode": StageTime(2.0, 3.0), "fusion": StageTime(0.5, 0.5)}


def test_stage_times_are_those_of_the_latest_keyframes_totals_those_of_all() -> None:
    ledger = Ledger()
    ledger.add_keyframe(True, True, 0, {"decode": 50.0})
    for _ in range(100):
        ledger.add_keyframe(True, True, 0, {"decode": 1.0})
    assert ledger.stage_times() == {"decode": StageTime(1.0, 1.0)}
    assert ledger.stages_s() == {"decode": 150.0}


def test_drops_can_outlive_a_run() -> None:
    drops = Drops()
    for _ in range(2):
        Ledger(drops).drops.add("queue_full", "slow")
    assert drops.counts() == {"queue_full": 2}
