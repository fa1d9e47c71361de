"""The node's life as a lifecycle manager sees it, and as a process that starts by itself."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from node_process import STAND_IN, end
from rclpy.context import Context
from rclpy.parameter import Parameter
from robot import TIMEOUT_S, Robot, stand_in_pipeline, wait_until
from stand_ins import wall_frame
from std_srvs.srv import Trigger

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.node.lifecycle import ManagedNode

STAMP_NS = 1_700_000_000 * 10**9
CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
INPUTS = ("rgb/image", "depth/image", "rgb/camera_info", "pose")


@pytest.fixture
def managed(make_robot) -> Robot:
    return make_robot(**{"node.autostart": False})


def change(robot: Robot, transition: int, label: str = "") -> bool:
    return robot.call(ChangeState, "change_state", transition=Transition(id=transition, label=label)).success


def state_of(robot: Robot) -> str:
    return robot.call(GetState, "get_state").current_state.label


def subscribers(robot: Robot) -> int:
    return sum(robot.user.count_subscribers(f"{robot.namespace}/{topic}") for topic in INPUTS)


def test_a_whole_life(managed) -> None:
    assert state_of(managed) == "unconfigured"
    assert managed.mapper.session is None
    assert change(managed, CONFIGURE)
    assert state_of(managed) == "inactive"
    assert subscribers(managed) == 0
    assert change(managed, ACTIVATE)
    managed.connect()
    managed.map(wall_frame(STAMP_NS))

    assert change(managed, DEACTIVATE)
    assert state_of(managed) == "inactive"
    wait_until(lambda: subscribers(managed) == 0, "inputs gone")
    assert managed.call(QueryText, "query_text", prompts=["red"]).success

    assert change(managed, ACTIVATE)
    managed.connect()
    managed.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    assert len(managed.mapper.pipeline.camera_poses()) == 2

    assert change(managed, DEACTIVATE)
    assert change(managed, CLEANUP)
    assert managed.mapper.session is None
    answer = managed.call(QueryText, "query_text", prompts=["red"])
    assert not answer.success
    assert "unconfigured" in answer.message

    assert change(managed, CONFIGURE)
    assert "map is empty" in managed.call(QueryText, "query_text", prompts=["red"]).message
    assert change(managed, Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert state_of(managed) == "finalized"
    assert managed.mapper.session is None


def test_shutdown_from_active_stops_everything(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    thread = robot.mapper.worker._thread
    assert change(robot, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state_of(robot) == "finalized"
    wait_until(lambda: subscribers(robot) == 0, "inputs gone")
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("transition", "label"),
    [(ACTIVATE, ""), (CLEANUP, ""), (Transition.TRANSITION_CALLBACK_SUCCESS, ""), (200, ""), (0, "activate"), (0, "dance")],
)
def test_a_transition_that_is_not_possible_is_refused_and_the_node_lives_on(managed, transition, label) -> None:
    assert not change(managed, transition, label)
    assert state_of(managed) == "unconfigured"
    assert change(managed, CONFIGURE)


def test_models_that_cannot_be_loaded_leave_a_managed_node_alive_and_unconfigured(make_robot) -> None:
    attempts: list[Any] = []

    def fails_once(config: Any) -> Pipeline:
        attempts.append(config)
        if len(attempts) == 1:
            raise EncoderError("parameter 'encoder.name': unknown encoder 'huge'")
        return stand_in_pipeline(config)

    robot = make_robot(fails_once, **{"node.autostart": False})
    assert not change(robot, CONFIGURE)
    assert state_of(robot) == "unconfigured"
    assert "'huge'" in str(robot.mapper.failure)
    assert robot.mapper.session is None
    assert change(robot, CONFIGURE)
    assert robot.mapper.failure is None


def test_inputs_that_cannot_be_subscribed_to_leave_the_node_inactive(make_robot) -> None:
    robot = make_robot(**{"node.autostart": False, "input.rgb_topic": "not a topic"})
    assert change(robot, CONFIGURE)
    assert not change(robot, ACTIVATE)
    assert state_of(robot) == "inactive"
    assert "not a topic" in str(robot.mapper.failure)
    assert robot.call(Trigger, "reset").success


def test_the_state_is_told_and_others_are_refused_while_models_load(make_robot) -> None:
    loading, gate = threading.Event(), threading.Event()

    def slow(config: Any) -> Pipeline:
        loading.set()
        assert gate.wait(60)
        return stand_in_pipeline(config)

    robot = make_robot(slow, **{"node.autostart": False})
    client = robot.user.create_client(ChangeState, "fus3dmaps/change_state")
    assert client.wait_for_service(60)
    configured = client.call_async(ChangeState.Request(transition=Transition(id=CONFIGURE)))
    assert loading.wait(60)
    assert state_of(robot) == "configuring"
    assert not change(robot, CONFIGURE)
    gate.set()
    wait_until(configured.done, "configured")
    assert configured.result().success
    assert state_of(robot) == "inactive"


def test_frames_that_wait_when_it_is_deactivated_are_not_mapped(make_robot) -> None:
    robot = make_robot()
    robot.map(wall_frame(STAMP_NS))
    entered, gate = threading.Event(), threading.Event()

    def hold() -> None:
        entered.set()
        assert gate.wait(60)

    held = robot.mapper.worker.between_frames(hold)
    assert entered.wait(60)
    robot.show(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    wait_until(lambda: robot.mapper.worker.waiting == 1, "a frame waits")
    assert change(robot, DEACTIVATE)
    gate.set()
    held.result(60)
    assert robot.mapper.worker.ledger.counts().dense_keyframes == 1
    assert robot.mapper.worker.waiting == 0


def test_parameters_of_the_map_change_while_unconfigured_alone(managed) -> None:
    mapper = managed.mapper
    assert mapper.set_parameters([Parameter("map.voxel_size_m", value=0.1)])[0].successful
    assert change(managed, CONFIGURE)
    assert mapper.pipeline.semantic_map.config.voxel_size_m == 0.1
    result = mapper.set_parameters([Parameter("map.voxel_size_m", value=0.2)])[0]
    assert not result.successful
    assert "map.voxel_size_m" in result.reason
    assert "unconfigured" in result.reason
    assert mapper.pipeline.semantic_map.config.voxel_size_m == 0.1
    assert change(managed, CLEANUP)
    assert mapper.set_parameters([Parameter("map.voxel_size_m", value=0.2)])[0].successful


def test_keyframe_thresholds_change_at_run_time(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    far = {f"keyframes.{layer}_{way}": 3.0 for layer in ("dense", "instance") for way in ("translation_m", "rotation_rad")}
    for name, value in far.items():
        assert robot.mapper.set_parameters([Parameter(name, value=value)])[0].successful
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))  # The first after a change is a keyframe.
    robot.show(wall_frame(STAMP_NS + 2 * 10**9, x_m=1.0))
    wait_until(lambda: robot.mapper.worker.ledger.counts().not_keyframes == 1, "too little motion now")


def test_every_state_has_a_number_that_managers_know(managed) -> None:
    assert managed.call(GetState, "get_state").current_state.id == State.PRIMARY_STATE_UNCONFIGURED
    assert change(managed, CONFIGURE)
    assert managed.call(GetState, "get_state").current_state.id == State.PRIMARY_STATE_INACTIVE


class Fragile(ManagedNode):
    """Fails where it is told to."""

    def __init__(self, context: Context, *failing: str) -> None:
        self.failing, self.done = set(failing), []
        super().__init__("fragile", context=context)

    def _do(self, name: str) -> None:
        self.done.append(name)
        if name in self.failing:
            raise RuntimeError(f"{name} does not work")

    def configure(self) -> None:
        self._do("configure")

    def activate(self) -> None:
        self._do("activate")

    def deactivate(self) -> None:
        self._do("deactivate")

    def cleanup(self) -> None:
        try:
            self._do("cleanup")
        finally:
            self.failing.discard("cleanup")


@pytest.fixture
def fragile() -> Iterator[Callable[..., Fragile]]:
    context = Context()
    rclpy.init(args=[], context=context)
    nodes: list[Fragile] = []

    def make(*failing: str) -> Fragile:
        nodes.append(Fragile(context, *failing))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("failing", "done", "state"),
    [
        (["configure"], ["configure", "cleanup"], "unconfigured"),
        (["activate"], ["configure", "activate", "deactivate"], "inactive"),
        # Not even taking back works at first: by way of error processing.
        (["configure", "cleanup"], ["configure", "cleanup", "deactivate", "cleanup"], "unconfigured"),
        (["activate", "deactivate"], ["configure", "activate", "deactivate", "deactivate", "cleanup"], "finalized"),
    ],
)
def test_what_fails_is_taken_back_and_raised(fragile, failing, done, state) -> None:
    node = fragile(*failing)
    with pytest.raises(RuntimeError, match=f"{failing[0]} does not work"):
        node.bring_up()
    assert (node.done, node.state) == (done, state)


def test_finalizing_gives_everything_back_once(fragile) -> None:
    node = fragile()
    node.bring_up()
    assert node.state == "active"
    node.trigger_shutdown()
    assert (node.done, node.state) == (["configure", "activate", "deactivate", "cleanup"], "finalized")


def test_a_process_without_autostart_waits_for_its_manager(start, user) -> None:
    process = start([*STAND_IN, "--ros-args", "-p", "node.autostart:=false"])
    get_state = user.create_client(GetState, "/fus3dmaps/get_state")
    change_state = user.create_client(ChangeState, "/fus3dmaps/change_state")
    assert get_state.wait_for_service(TIMEOUT_S)
    assert change_state.wait_for_service(TIMEOUT_S)

    def state() -> str:
        future = get_state.call_async(GetState.Request())
        wait_until(future.done, "the state")
        return future.result().current_state.label

    assert state() == "unconfigured"
    for transition, reached in ((CONFIGURE, "inactive"), (ACTIVATE, "active"), (DEACTIVATE, "inactive")):
        future = change_state.call_async(ChangeState.Request(transition=Transition(id=transition)))
        wait_until(future.done, reached)
        assert state() == reached
    end(process, signal.SIGTERM)
