"""Running a node as a process: from arguments to an exit code, with signals and errors handled."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_ros.node.executor import CallbackExecutor
from fus3dmaps_ros.node.lifecycle import ManagedNode
from fus3dmaps_ros.node.refusals import REFUSALS, one_line
from fus3dmaps_ros.node.signals import StopSignals

_STOP_TIMEOUT_S = 1.0


def run_node(name: str, make_node: Callable[[], ManagedNode], args: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM.

    Args:
        name: The program's name, at the start of each line on stderr.
        make_node: Makes the node, after ROS is initialised.
        args: Arguments without the program's name, ``--ros-args ...``; by default those of the process.

    Returns:
        Exit code: 0 after a signal, 1 after a refusal, which is one line on stderr.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    signals = StopSignals()
    code = 0
    node, executor = None, None
    try:
        # Without rclpy's handlers, which would shut the context down while callbacks are running.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        stray = remove_ros_args(arguments)
        if stray:
            raise ConfigError(f"unknown arguments: {' '.join(stray)}; ROS arguments follow --ros-args")
        node = make_node()
        executor = CallbackExecutor()
        executor.add_node(node)
        # Python runs signal handlers only in the main thread, and not while that waits inside the middleware.
        spinning = ThreadPoolExecutor(1, "spin").submit(executor.spin_on, node.get_logger().error)
        if node.autostart:
            # While it spins, so that a manager or an operator can see the state while the models load.
            node.bring_up()
        signals.wait_for(spinning)
    except KeyboardInterrupt:
        pass
    except REFUSALS as error:
        signals.hold()
        print(f"{name}: {one_line(error)}", file=sys.stderr)
        code = 1
    except Exception:
        signals.hold()
        traceback.print_exc()
        code = 1
    _shut_down(name, node, executor, signals, code)
    return code


def _shut_down(
    name: str, node: ManagedNode | None, executor: CallbackExecutor | None, signals: StopSignals, code: int
) -> None:
    """Shut everything down within two seconds, apart from a last save if one is due."""
    signals.hold()
    unfinished = []
    if executor is not None and not executor.shutdown(_STOP_TIMEOUT_S / 2):
        unfinished.append("call")
    if node is not None:
        if not node.stop(_STOP_TIMEOUT_S):
            unfinished.append("frame")
        if not node.save_last(lambda: signals.hurried):
            unfinished.append("save")
        node.destroy_node()
    rclpy.try_shutdown()
    if unfinished:
        print(f"{name}: ending in the middle of a {' and a '.join(unfinished)}", file=sys.stderr)
        # A normal exit would wait for native code that is still running, or crash it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
