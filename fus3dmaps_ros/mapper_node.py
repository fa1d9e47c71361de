"""The mapper node ``fus3dmaps``: wires topics and services to the pipeline."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from fus3dmaps_core.config import Config
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_ros.drops import DropLog
from fus3dmaps_ros.inputs import Inputs
from fus3dmaps_ros.outputs import Outputs
from fus3dmaps_ros.parameters import declare_parameters, follow_changes, unknown_overrides
from fus3dmaps_ros.refusals import REFUSALS
from fus3dmaps_ros.services import Services
from fus3dmaps_ros.worker import FrameWorker

NODE_NAME = "fus3dmaps"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STATUS_PERIOD_S = 5.0
_STOP_TIMEOUT_S = 1.0
# Inputs, outputs, queries and commands each have a group that runs one callback at a time.
_EXECUTOR_THREADS = 4


class MapperNode(Node):
    """Maps what the camera sees and answers questions about it."""

    def __init__(self, make_pipeline: Callable[[Config], Pipeline] = Pipeline.from_config, **options: Any) -> None:
        """Read the parameters, load the models and start to map.

        Args:
            make_pipeline: Builds the pipeline from the configuration; loads the models.
            options: For ``rclpy.node.Node``, e.g. ``context``, ``namespace`` or ``parameter_overrides``.

        Raises:
            ConfigError: A parameter is wrong; the message names it.
            EncoderError: A model cannot be loaded.
        """
        super().__init__(NODE_NAME, **options)
        logger = self.get_logger()
        self.config = declare_parameters(self)
        for sentence in unknown_overrides(self):
            logger.warning(sentence)
        logger.info(f"loading encoder '{self.config.encoder.name}' and segmenter '{self.config.segmenter.name}'")
        started = time.monotonic()
        self.pipeline = make_pipeline(self.config)
        logger.info(f"models loaded in {time.monotonic() - started:.1f} s")

        self.drops = DropLog(logger.warning)
        self.worker = FrameWorker(self.pipeline, self.config.node.queue_size, self.drops)
        self._outputs = Outputs(self, self.pipeline, self.worker, self._read_config)
        self._inputs = Inputs(self, self.config, self.worker.offer, self.drops)
        self._offered = Services(self, self.pipeline, self.worker, self._inputs, self._outputs, self._read_config)
        follow_changes(self, self._read_config, self._apply_config)
        self._last_status = ""
        self._status_timer = self.create_timer(
            _STATUS_PERIOD_S,
            self._log_status,
            callback_group=MutuallyExclusiveCallbackGroup(),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self.worker.start()
        logger.info("ready")

    def stop(self, timeout_s: float) -> bool:
        """End the mapping thread; whether it ended in time."""
        return self.worker.stop(timeout_s)

    def status(self) -> str:
        """One line on what came in, what was mapped, what was dropped and how large the map is."""
        counts, semantic_map = self.worker.counts(), self.pipeline.semantic_map
        drops = ", ".join(f"{reason} {count}" for reason, count in sorted(self.drops.counts().items()))
        return (
            f"{counts.frames} frames, {counts.not_keyframes} not keyframes, {counts.dense_keyframes} dense and "
            f"{counts.instance_keyframes} instance keyframes, {self.worker.waiting} waiting; dropped: {drops or 'none'}; "
            f"{semantic_map.voxel_count} voxels, {semantic_map.instance_count} instances"
        )

    def _log_status(self) -> None:
        silent = self._inputs.silent()
        status = self.status() + (f"; nothing received yet on {', '.join(silent)}" if silent else "")
        if status != self._last_status:
            self.get_logger().info(status)
        self._last_status = status

    def _read_config(self) -> Config:
        return self.config

    def _apply_config(self, config: Config) -> None:
        self.config = config


def main(args: Sequence[str] | None = None, make_pipeline: Callable[[Config], Pipeline] = Pipeline.from_config) -> int:
    """Run the node until SIGINT or SIGTERM, in a process of its own.

    Args:
        args: Arguments without the program's name, ``--ros-args ...``; those of the process by default.
        make_pipeline: As for :class:`MapperNode`.

    Returns:
        Exit code: 0 after a signal, 1 after a refusal, which is one line on stderr.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    for number in _SIGNALS:
        signal.signal(number, signal.default_int_handler)
    code = 0
    node, executor = None, None
    try:
        # Without rclpy's handlers, which would pull the context from under callbacks in work.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        stray = remove_ros_args(arguments)
        if stray:
            raise ConfigError(f"unknown arguments: {' '.join(stray)}; ROS arguments follow --ros-args")
        node = MapperNode(make_pipeline)
        executor = CallbackExecutor(_EXECUTOR_THREADS)
        executor.add_node(node)
        # Python runs signal handlers in the main thread alone, and not while that waits inside the middleware.
        ThreadPoolExecutor(1, "spin").submit(executor.spin).result()
    except KeyboardInterrupt:
        pass
    except REFUSALS as error:
        print(f"{NODE_NAME}: {error}", file=sys.stderr)
        code = 1
    except Exception:
        traceback.print_exc()
        code = 1
    _shut_down(node, executor, code)
    return code


class CallbackExecutor(MultiThreadedExecutor):
    """A multi-threaded executor that can be ended without cutting callbacks off."""

    def finish(self, timeout_s: float) -> bool:
        """Start no more callbacks; whether those in work were done within the time."""
        self.shutdown()
        return bool(self._work_tracker.wait(timeout_s))


def _shut_down(node: MapperNode | None, executor: CallbackExecutor | None, code: int) -> None:
    """Take everything down within two seconds; a second signal cannot interrupt it."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    answered = executor is None or executor.finish(_STOP_TIMEOUT_S / 2)
    mapped = node is None or node.stop(_STOP_TIMEOUT_S)
    if node is not None:
        node.destroy_node()
    rclpy.try_shutdown()
    if not (answered and mapped):
        print(f"{NODE_NAME}: ending in the middle of a {'frame' if answered else 'call'}", file=sys.stderr)
        # The interpreter's own end would wait for native code that is in work, or crash it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    sys.exit(main())
