"""The mapper node ``fus3dmaps``: a managed node that wires topics and services to the pipeline."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from std_msgs.msg import Header

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.ledger import Drops, Ledger
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.sources.streams import uses_tf
from fus3dmaps_msgs.msg import MapperStatus
from fus3dmaps_ros.node.autosave import Autosave
from fus3dmaps_ros.node.drop_log import DropLog
from fus3dmaps_ros.node.lifecycle import UNCONFIGURED, ManagedNode
from fus3dmaps_ros.node.map_store import resume_newest
from fus3dmaps_ros.node.parameters import declare_parameters, follow_changes, unknown_overrides
from fus3dmaps_ros.node.process import run_node
from fus3dmaps_ros.node.session import Session, SessionHolder
from fus3dmaps_ros.node.worker import FrameWorker
from fus3dmaps_ros.reporting.health_monitor import HealthMonitor
from fus3dmaps_ros.reporting.status import StatusPublisher, status_line, status_message
from fus3dmaps_ros.services.maps import MapServices
from fus3dmaps_ros.services.queries import QueryServices
from fus3dmaps_ros.topics.inputs import Inputs
from fus3dmaps_ros.topics.outputs import Outputs
from fus3dmaps_ros.topics.tf_poses import import_tf2_ros

NODE_NAME = "fus3dmaps"


class MapperNode(ManagedNode):
    """Maps what the camera sees and answers questions about it.

    While unconfigured it has neither models nor a map. While inactive it has both and answers, but takes no images. While
    active it maps. Its topics and services appear when it is configured for the first time.

    Attributes:
        config: The configuration in force.
        drops: Counts of messages and frames that were dropped.
        autosave: Saves the map periodically; None while unconfigured.
    """

    def __init__(self, make_pipeline: Callable[[Config], Pipeline] = Pipeline.from_config, **options: Any) -> None:
        """Read the parameters, without loading anything.

        Args:
            make_pipeline: Builds the pipeline from the configuration and loads the models.
            options: Options of ``rclpy.node.Node``, e.g. ``context``, ``namespace`` or ``parameter_overrides``.

        Raises:
            ConfigError: A parameter is wrong; the message names it.
        """
        super().__init__(NODE_NAME, **options)
        logger = self.get_logger()
        self._make_pipeline = make_pipeline
        self._sessions = SessionHolder()
        self._outputs: Outputs | None = None
        self._offered: list[QueryServices | MapServices] = []
        self._inputs: Inputs | None = None
        self._monitor: HealthMonitor | None = None
        self.autosave: Autosave | None = None
        self.drops = Drops(DropLog(logger.warning).report)
        self.config = declare_parameters(self)
        self.autostart = self.config.node.autostart
        for sentence in unknown_overrides(self):
            logger.warning(sentence)
        follow_changes(self, self._read_config, self._apply_config, lambda: self.state != UNCONFIGURED)
        self._status = StatusPublisher(self, self._read_config, self.status_message, self._log_line)

    @property
    def session(self) -> Session | None:
        """Models, map and mapping thread; None while unconfigured."""
        return self._sessions.current

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline; raises MapError while unconfigured."""
        return self._sessions.require().pipeline

    @property
    def worker(self) -> FrameWorker:
        """The thread that feeds the pipeline; raises MapError while unconfigured."""
        return self._sessions.require().worker

    def configure(self) -> None:
        """Load and warm up the models, resume a saved map if configured, and offer topics and services.

        Raises:
            ConfigError: TF is needed and not installed.
            EncoderError: A model cannot be loaded.
        """
        logger, config = self.get_logger(), self.config
        if uses_tf(config.input):
            import_tf2_ros()  # Refuses before models are loaded in vain.
        logger.info(f"loading encoder '{config.encoder.name}' and segmenter '{config.segmenter.name}'")
        started = time.monotonic()
        pipeline = self._make_pipeline(config)
        logger.info(f"models loaded in {time.monotonic() - started:.1f} s")
        session = Session(pipeline, FrameWorker(pipeline, config.node.queue_size, Ledger(self.drops)))
        session.worker.start()
        self._sessions.replace(session)
        if self.config is not config:
            self._apply_config(self.config)  # It changed while the models were loaded.
        if config.node.resume:
            resume_newest(session, config.node.map_directory, logger)
        self.autosave = Autosave(session, self._read_config, logger)
        self.autosave.start()
        if self._outputs is None:
            # Only once: destroying a service or publisher that a callback is using would end the executor.
            self._outputs = Outputs(self, self._sessions, self._read_config)
            self._offered = [
                QueryServices(self, self._sessions, self._outputs, self._read_config),
                MapServices(self, self._sessions, self._outputs, self._read_config, self._forget_inputs),
            ]

    def activate(self) -> None:
        """Subscribe to the inputs and start mapping.

        Raises:
            ConfigError: The parameters of the inputs cannot be used.
        """
        self._inputs = Inputs(self, self.config, self.worker.offer, self.drops, self._arrived)
        self._monitor = HealthMonitor(self, self.config, self._inputs.streams, self._sessions.require())
        self.worker.observer = self._monitor
        self.drops.tell(self._monitor.dropped)
        self.get_logger().info("ready")

    def deactivate(self) -> None:
        """Unsubscribe and drop the frames that wait; the map stays."""
        inputs, self._inputs = self._inputs, None
        if inputs is not None:
            inputs.close()
        session = self.session
        if session is not None:
            session.worker.drop_waiting()
            session.worker.observer = None
        monitor, self._monitor = self._monitor, None
        if monitor is not None:
            self.drops.stop_telling(monitor.dropped)
            monitor.close()

    def cleanup(self) -> None:
        """Free the map and the models, after a last save if the map is saved periodically."""
        self._end_session()
        if self._outputs is not None:
            self._outputs.clear_answers()
        gc.collect()
        if torch.cuda.is_initialized():
            torch.cuda.empty_cache()

    def _end_session(self) -> None:
        autosave, self.autosave = self.autosave, None
        session, timeout_s = self.session, self.config.node.service_timeout_s
        if session is not None and not session.worker.stop(timeout_s):
            self.get_logger().warning("the frame in work goes on; its models are freed when it is done")
        if autosave is not None and not autosave.stop(timeout_s, save=True):
            self.get_logger().warning("the last save goes on; until it is complete the map saved before is the newest")
        self._sessions.replace(None)

    def stop(self, timeout_s: float) -> bool:
        """Unsubscribe and end the mapping thread, in any state; the map stays. Return whether the thread ended in time."""
        self.deactivate()
        session = self.session
        return session is None or session.worker.stop(timeout_s)

    def save_last(self, hurried: Callable[[], bool]) -> bool:
        """Save the map a last time after :meth:`stop`, if that is due, within ``node.service_timeout_s``."""
        autosave = self.autosave
        return autosave is None or autosave.save_last(self.config.node.service_timeout_s, hurried)

    def status(self) -> str:
        """Describe in one line what came in, what was mapped, what was dropped and how large the map is."""
        return status_line(self.session, self.drops.counts())

    def status_message(self) -> MapperStatus:
        """Make the message that ``~/status`` publishes now."""
        monitor = self._monitor
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.config.input.map_frame)
        return status_message(
            header,
            self.state,
            self.config,
            self.session,
            self.autosave,
            self.drops.counts(),
            {} if monitor is None else monitor.diagnosis.rates_hz(),
            self.problems(),
        )

    def _forget_inputs(self) -> None:
        inputs = self._inputs
        if inputs is not None:
            inputs.reset()

    def problems(self) -> list[str]:
        """Return sentences that say what is wrong; none unless the node is active."""
        monitor = self._monitor
        return [problem.sentence for problem in monitor.problems()] if monitor is not None else []

    def _arrived(self, topic: str, stamp_ns: int) -> None:
        monitor = self._monitor
        if monitor is not None:  # It is made shortly after the inputs that it monitors.
            monitor.arrived(topic, stamp_ns)

    def _log_line(self) -> tuple[str, dict[str, str]]:
        """Return a line for the log on the state of mapping, and the problems by kind."""
        if self.session is None:
            return self.state, {}
        monitor = self._monitor
        return self.status(), {each.kind: each.sentence for each in (monitor.problems() if monitor is not None else [])}

    def _read_config(self) -> Config:
        return self.config

    def _apply_config(self, config: Config) -> None:
        self.config = config
        self._status.follow(config)
        session = self.session
        if session is not None:
            session.worker.between_frames(lambda: session.pipeline.reconfigure(config), changes=False)
        if self._outputs is not None:
            self._outputs.follow(config)
        if self.autosave is not None:
            self.autosave.follow()


def main(args: Sequence[str] | None = None, make_pipeline: Callable[[Config], Pipeline] = Pipeline.from_config) -> int:
    """Run the node in this process until SIGINT or SIGTERM.

    A map that is saved periodically is then saved a last time, unless that takes longer than ``node.service_timeout_s`` or
    another signal comes. With ``node.autostart`` the node starts to map by itself; otherwise it waits, unconfigured, for a
    lifecycle manager.

    Args:
        args: See :func:`run_node`, also for the exit code that is returned.
        make_pipeline: See :class:`MapperNode`.
    """
    return run_node(NODE_NAME, lambda: MapperNode(make_pipeline), args)


if __name__ == "__main__":
    sys.exit(main())
