"""The head driver as a process over DDS, with the fake head behind a real pseudo-terminal."""
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from ps_head_driver.calibration_file import HeadCalibration as Calibrated  # noqa: E402
from ps_head_driver.conversions import calibration_to_message  # noqa: E402
from ps_head_driver.errors import ErrorCode  # noqa: E402
from ps_head_driver.fake.trigger_socket import ControlClient, TriggerListener  # noqa: E402
from ps_head_driver.head_model import load_head, nominal_head_path  # noqa: E402
from ps_head_driver.ros_support import LATCHED, RELIABLE  # noqa: E402
from ps_interfaces.msg import HeadCalibration, HeadStatus, Panel, StrobeStep  # noqa: E402
from ps_interfaces.srv import RunStrobeProgram, SetIllumination  # noqa: E402

pytestmark = pytest.mark.graph
DOMAIN = 60 + os.getpid() % 40
NODE = '/cell/head_driver'


class Graph:
    """The driver's process and a client beside it."""

    def __init__(self, folder: Path) -> None:
        self.socket = folder / 'trigger.sock'
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self.node = rclpy.create_node('tester', namespace='cell', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        self.statuses: list[HeadStatus] = []
        self.node.create_subscription(HeadStatus, 'head_status', self.statuses.append, LATCHED)
        self._clients: dict[str, Any] = {}
        self.process = self.start()

    def start(self, *parameters: str) -> subprocess.Popen:
        parameters = parameters or ('fake_hardware:=true', f'trigger_socket:={self.socket}')
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'ps_head_driver.nodes.head_driver', '--ros-args',
             '-r', '__ns:=/cell', *(word for text in parameters for word in ('-p', text))],
            env={**os.environ, 'ROS_DOMAIN_ID': str(DOMAIN)})
        return self.process

    def end(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(10)

    def call(self, kind: type, name: str, request: Any = None, timeout: float = 10.0) -> Any:
        future = self.ask(kind, name, request)
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(timeout), f'{name} did not answer'
        return future.result()

    def ask(self, kind: type, name: str, request: Any = None) -> Any:
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self.node.create_client(kind, name)
        assert client.wait_for_service(10.0), f'{name} is not there'
        return client.call_async(kind.Request() if request is None else request)

    def wait_status(self, condition: Callable[[HeadStatus], bool], timeout: float = 15.0,
                    newer_than: int = 0) -> HeadStatus:
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            for status in self.statuses[newer_than:][-1:]:
                if condition(status):
                    return status
            time.sleep(0.01)
        raise AssertionError(f'last status: {self.statuses[-1:]}')

    def ready(self, timeout: float = 20.0, newer_than: int = 0) -> HeadStatus:
        return self.wait_status(lambda s: s.state == HeadStatus.READY, timeout, newer_than)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        self._thread.join(5.0)


@pytest.fixture(scope='module')
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    graph = Graph(tmp_path_factory.mktemp('head'))
    try:
        graph.ready()
        yield graph
    finally:
        graph.close()


@pytest.fixture
def control(graph: Graph) -> Iterator[ControlClient]:
    graph.ready()
    with ControlClient(graph.socket) as control:
        yield control


def ring(strobe: float = 0.004, panels: str = 'ENWS') -> list[StrobeStep]:
    return [StrobeStep(mode=Panel.BRIGHT_FIELD, panel=getattr(Panel, panel), intensity=1.0,
                       settle=0.002, strobe_duration=strobe, period=0.0167) for panel in panels]


def illuminate(**fields: Any) -> SetIllumination.Request:
    return SetIllumination.Request(**fields)


MOVE = SetIllumination.Request.BY_MOTOR_COUNTS


def test_status_is_latched_and_complete(graph: Graph) -> None:
    late: list[HeadStatus] = []
    subscription = graph.node.create_subscription(HeadStatus, 'head_status', late.append, LATCHED)
    deadline = time.monotonic() + 5
    while not late and time.monotonic() < deadline:
        time.sleep(0.01)
    graph.node.destroy_subscription(subscription)
    status = late[0]
    assert status.state == HeadStatus.READY
    assert status.fake
    assert status.homed
    assert status.serial_number == 'FAKE-0001'
    assert status.firmware_version == '0.1.0'
    assert status.error_code == 0
    assert status.tilt == pytest.approx(0.0, abs=1e-3)
    assert len(status.panel_temperatures) == 8
    assert all(290 < t < 310 for t in status.panel_temperatures)


def test_illumination_and_program(graph: Graph, control: ControlClient) -> None:
    answer = graph.call(SetIllumination, 'set_illumination', illuminate(
        by=SetIllumination.Request.BY_CONVERGENCE_RADIUS, convergence_radius=0.06,
        dark_field_tilt=1.3, intensities=[1.0, 0.5] + [1.0] * 6))
    assert answer.success, answer.message
    assert answer.convergence_radius == pytest.approx(0.06, abs=5e-5)
    assert len(answer.lights) == 8
    assert [light.intensity for light in answer.lights[:2]] == pytest.approx([1.0, 0.5], abs=1e-4)
    assert control.command('state')['slider_counts'] == pytest.approx(answer.motor_counts, abs=4)
    axis = answer.lights[0].axis
    assert (axis.x, axis.y, axis.z) == pytest.approx(
        (-math.sin(answer.tilt), 0.0, -math.cos(answer.tilt)), abs=1e-9)

    listener = TriggerListener(graph.socket)
    assert listener.wait_connected(2.0)
    program = graph.call(RunStrobeProgram, f'{NODE}/run_strobe_program',
                         RunStrobeProgram.Request(steps=[*ring(), *ring(panels=['NONE'])]))
    assert program.success, program.message
    assert program.steps_done == 5
    assert [light.name for light in program.lights] == [
        'BF_E', 'BF_N', 'BF_W', 'BF_S', 'NONE']
    assert program.lights[1].intensity == pytest.approx(0.5, abs=1e-4)
    for i, light in enumerate(program.lights):
        event = listener.get(1.0)
        assert event is not None
        assert light.strobe_counter == event.strobe_counter == program.first_strobe_counter + i
        assert light.device_time_ns == event.device_time_ns
        assert light.tilt == pytest.approx(event.tilt, abs=2e-4)
        assert max(event.bf_levels) == pytest.approx([1.0, 0.5, 1.0, 1.0, 0.0][i], abs=1e-4)
    assert program.lights[0].position == answer.lights[0].position
    listener.close()


def test_wrong_requests_are_answered(graph: Graph, control: ControlClient) -> None:
    by = SetIllumination.Request
    step = ring()[0]
    cases: list[tuple[type, str, Any, ErrorCode]] = [
        (SetIllumination, 'set_illumination', request, code) for request, code in (
            (illuminate(by=9), ErrorCode.HEAD_BAD_REQUEST),
            (illuminate(by=MOVE, motor_counts=-1), ErrorCode.HEAD_OUT_OF_LIMITS),
            (illuminate(by=MOVE, motor_counts=64001), ErrorCode.HEAD_OUT_OF_LIMITS),
            (illuminate(by=by.BY_TILT, tilt=3.0), ErrorCode.HEAD_OUT_OF_LIMITS),
            (illuminate(by=by.BY_TILT, tilt=math.nan), ErrorCode.HEAD_BAD_REQUEST),
            (illuminate(by=by.BY_CONVERGENCE_RADIUS, convergence_radius=5.0, branch=1),
             ErrorCode.CR_UNREACHABLE),
            (illuminate(by=by.BY_CONVERGENCE_RADIUS, convergence_radius=0.06, branch=3),
             ErrorCode.HEAD_BAD_REQUEST),
            (illuminate(by=by.KEEP, intensities=[1.0]), ErrorCode.HEAD_BAD_REQUEST),
            (illuminate(by=by.KEEP, intensities=[1.5] * 8), ErrorCode.HEAD_BAD_REQUEST),
            (illuminate(by=by.KEEP, dark_field_tilt=0.1), ErrorCode.HEAD_BAD_REQUEST))]
    for field, value in (('mode', 7), ('panel', 9), ('intensity', 1.01), ('settle', -1.0),
                         ('strobe_duration', 0.0), ('period', math.inf)):
        wrong = StrobeStep(**{
            **{name: getattr(step, name) for name in step.get_fields_and_field_types()},
            field: value})
        cases.append((RunStrobeProgram, f'{NODE}/run_strobe_program',
                      RunStrobeProgram.Request(steps=[wrong]), ErrorCode.HEAD_BAD_REQUEST))
    for steps in ([], ring() * 10, ring(strobe=10.0)):
        cases.append((RunStrobeProgram, f'{NODE}/run_strobe_program',
                      RunStrobeProgram.Request(steps=steps), ErrorCode.HEAD_PROGRAM_REJECTED))
    for kind, name, request, code in cases:
        answer = graph.call(kind, name, request)
        assert not answer.success
        assert ErrorCode(answer.error_code) is code, (request, answer.message)
        assert answer.message
    assert control.command('state')['faults'] == 0
    graph.ready()


def test_parameters_are_checked_and_work_at_run_time(graph: Graph) -> None:
    def set_parameter(name: str, value: Any) -> Any:
        parameter = Parameter(name, value=value).to_parameter_msg()
        return graph.call(SetParameters, f'{NODE}/set_parameters',
                          SetParameters.Request(parameters=[parameter])).results[0]

    assert not set_parameter('settle_time', -1.0).successful
    assert not set_parameter('baud', 9600).successful          # only at start
    assert set_parameter('speed', 15000).successful
    graph.call(SetIllumination, 'set_illumination', illuminate(by=MOVE, motor_counts=1000))
    start = time.monotonic()
    graph.call(SetIllumination, 'set_illumination', illuminate(by=MOVE, motor_counts=16000))
    assert time.monotonic() - start > 0.9


def test_from_above_the_play_of_the_motor_is_made_up_for(graph: Graph) -> None:
    graph.ready()
    calibrated = graph.node.create_publisher(HeadCalibration, 'calibration', LATCHED)
    nominal = load_head(nominal_head_path())
    latched = calibration_to_message(Calibrated(
        calibration_id='play', created=datetime.now(UTC), head_serial='', camera=nominal.camera,
        backlash_counts=300, verdict='OK'), nominal)
    by_cr = SetIllumination.Request(by=SetIllumination.Request.BY_CONVERGENCE_RADIUS,
                                    convergence_radius=0.06)
    below = graph.call(SetIllumination, 'set_illumination', by_cr)
    try:
        calibrated.publish(latched)
        assert graph.call(SetParameters, NODE + '/set_parameters', SetParameters.Request(
            parameters=[Parameter('approach', value='down').to_parameter_msg()])
            ).results[0].successful
        # the calibration arrives by another way than requests
        deadline = time.monotonic() + 5.0
        while True:
            above = graph.call(SetIllumination, 'set_illumination', by_cr)
            if above.motor_counts != below.motor_counts or time.monotonic() > deadline:
                break
        assert above.motor_counts == pytest.approx(below.motor_counts - 300, abs=4)
        assert above.tilt == pytest.approx(below.tilt, abs=1e-4)
        assert above.convergence_radius == pytest.approx(0.06, abs=1e-4)
    finally:
        graph.call(SetParameters, NODE + '/set_parameters', SetParameters.Request(
            parameters=[Parameter('approach', value='up').to_parameter_msg()]))
        calibrated.publish(calibration_to_message(None, nominal))


def test_busy_is_refused_and_stop_gets_in(graph: Graph, control: ControlClient) -> None:
    future = graph.ask(SetIllumination, 'set_illumination',
                       illuminate(by=MOVE, motor_counts=60000))
    graph.wait_status(lambda s: s.state == HeadStatus.MOVING)
    second = graph.call(SetIllumination, 'set_illumination', illuminate(by=MOVE, motor_counts=5))
    assert ErrorCode(second.error_code) is ErrorCode.HEAD_BUSY
    home = graph.call(Trigger, f'{NODE}/home')
    assert not home.success
    assert home.message.startswith('HEAD_BUSY')
    start = time.monotonic()
    assert graph.call(Trigger, f'{NODE}/stop').success
    stopped_s = time.monotonic() - start
    assert control.command('state')['activity'] in ('IDLE', 'STOPPING')
    while not future.done() and time.monotonic() - start < 5:
        time.sleep(0.01)
    assert ErrorCode(future.result().error_code) is ErrorCode.HEAD_CANCELLED
    print(f'stop answered after {stopped_s * 1e3:.0f} ms')
    assert stopped_s < 1.0
    graph.ready()

    future = graph.ask(RunStrobeProgram, f'{NODE}/run_strobe_program',
                       RunStrobeProgram.Request(steps=ring(strobe=1.5, panels='E')))
    graph.wait_status(lambda s: s.state == HeadStatus.STROBING)
    assert control.command('state')['panels_on']
    assert graph.call(Trigger, f'{NODE}/stop').success
    assert not control.command('state')['panels_on']


def test_a_fault_is_shown_and_cleared(graph: Graph, control: ControlClient) -> None:
    graph.ready()
    control.command('led_open', panels=4)
    program = graph.call(RunStrobeProgram, f'{NODE}/run_strobe_program',
                         RunStrobeProgram.Request(steps=ring()))
    assert ErrorCode(program.error_code) is ErrorCode.HEAD_LED_OPEN
    assert program.steps_done == len(program.lights) == 2
    status = graph.wait_status(lambda s: s.state == HeadStatus.FAULT)
    assert 'BF_W' in status.message
    control.command('led_open', panels=0)
    assert graph.call(Trigger, f'{NODE}/clear_fault').success
    graph.ready()


def test_diagnostics(graph: Graph) -> None:
    arrays: list[DiagnosticArray] = []
    graph.node.create_subscription(DiagnosticArray, '/diagnostics', arrays.append, RELIABLE)
    deadline = time.monotonic() + 5
    while not arrays and time.monotonic() < deadline:
        time.sleep(0.02)
    by_name = {status.name: status for status in arrays[0].status}
    assert set(by_name) == {f'cell/head_driver: {task}' for task in ('Link', 'Motor', 'Panels')}
    assert all(status.level == b'\0' for status in by_name.values())
    assert all(status.hardware_id == 'FAKE-0001' for status in by_name.values())


def test_unplugged_and_plugged_again(graph: Graph, control: ControlClient) -> None:
    control.command('unplug')
    graph.wait_status(lambda s: s.state == HeadStatus.DISCONNECTED, 2.0)
    answer = graph.call(SetIllumination, 'set_illumination', illuminate(by=MOVE, motor_counts=5))
    assert ErrorCode(answer.error_code) is ErrorCode.HEAD_DISCONNECTED
    assert graph.call(Trigger, f'{NODE}/reconnect').message.startswith('HEAD_DISCONNECTED')
    assert graph.call(Trigger, f'{NODE}/stop').message.startswith('HEAD_DISCONNECTED')
    seen = len(graph.statuses)
    control.command('plug')
    start = time.monotonic()
    assert graph.ready(newer_than=seen).homed
    recovered_s = time.monotonic() - start
    print(f'plugged to homed: {recovered_s:.2f} s')
    assert recovered_s < 2.0
    assert graph.call(Trigger, f'{NODE}/reconnect').success
    graph.ready()


def test_deactivated_it_refuses(graph: Graph) -> None:
    def change(transition: int) -> None:
        assert graph.call(ChangeState, f'{NODE}/change_state', ChangeState.Request(
            transition=Transition(id=transition))).success

    change(Transition.TRANSITION_DEACTIVATE)
    answer = graph.call(SetIllumination, 'set_illumination')
    assert ErrorCode(answer.error_code) is ErrorCode.HEAD_NOT_ACTIVE
    assert graph.statuses[-1].error_code == ErrorCode.HEAD_NOT_ACTIVE
    seen = len(graph.statuses)
    change(Transition.TRANSITION_ACTIVATE)
    graph.ready(newer_than=seen)


def test_killed_the_light_goes_off_and_nothing_stays_behind(
        graph: Graph, control: ControlClient) -> None:
    graph.ask(RunStrobeProgram, f'{NODE}/run_strobe_program',
              RunStrobeProgram.Request(steps=ring(strobe=1.8, panels='E')))
    graph.wait_status(lambda s: s.state == HeadStatus.STROBING)
    graph.process.send_signal(signal.SIGKILL)
    start = time.monotonic()
    while control.command('state')['panels_on']:
        assert time.monotonic() - start < 0.5
        time.sleep(0.005)
    print(f'kill -9 to panels off: {time.monotonic() - start:.3f} s')
    graph.process.wait()
    while graph.socket.exists():
        assert time.monotonic() - start < 5, 'the fake head has outlived its driver'
        time.sleep(0.05)

    seen = len(graph.statuses)
    graph.start()
    graph.ready(newer_than=seen)
    assert graph.end(signal.SIGINT) == 0
    assert not graph.socket.exists()
    assert not graph.socket.with_suffix('.tty').is_symlink()


def test_sigterm_and_a_bad_file_have_clean_exits(graph: Graph) -> None:
    if graph.process.poll() is None:
        graph.end()
    seen = len(graph.statuses)
    graph.start()
    graph.ready(newer_than=seen)
    assert graph.end(signal.SIGTERM) == 0
    bad = subprocess.run(
        [sys.executable, '-m', 'ps_head_driver.nodes.head_driver', '--ros-args',
         '-p', 'head_file:=/nowhere/head.yaml'], capture_output=True, text=True, timeout=20,
        env={**os.environ, 'ROS_DOMAIN_ID': str(DOMAIN)}, check=False)
    assert bad.returncode == 1
    assert 'HEAD_BAD_REQUEST: /nowhere/head.yaml' in bad.stderr


def test_two_boards_on_two_serial_ports(graph: Graph, tmp_path: Path) -> None:
    if graph.process.poll() is None:
        graph.end()
    motor, lights, socket = (tmp_path / name for name in ('motor', 'lights', 'trigger.sock'))
    emulator = subprocess.Popen(
        [sys.executable, '-m', 'ps_head_driver.fake.emulator_process', '--port', motor,
         '--lights-port', lights, '--trigger-socket', socket], stdout=subprocess.PIPE)
    try:
        assert emulator.stdout is not None
        assert emulator.stdout.readline().startswith(b'ready')
        seen = len(graph.statuses)
        graph.start(f'port:={motor}', f'lights_port:={lights}')
        assert not graph.ready(newer_than=seen).fake
        answer = graph.call(SetIllumination, 'set_illumination',
                            illuminate(by=MOVE, motor_counts=20000))
        assert answer.success, answer.message
        program = graph.call(RunStrobeProgram, f'{NODE}/run_strobe_program',
                             RunStrobeProgram.Request(steps=ring()))
        assert program.success, program.message
        assert [light.motor_counts for light in program.lights] == [20000] * 4

        # killed while moving: the boards are left alone, and their watchdogs act
        graph.ask(SetIllumination, 'set_illumination', illuminate(by=MOVE, motor_counts=64000))
        with ControlClient(socket) as control:
            graph.wait_status(lambda s: s.state == HeadStatus.MOVING)
            graph.process.send_signal(signal.SIGKILL)
            start = time.monotonic()
            while control.command('state')['activity'] != 'IDLE':
                assert time.monotonic() - start < 0.55
                time.sleep(0.005)
        graph.process.wait()
    finally:
        emulator.terminate()
        assert emulator.wait(5) == 0
    assert not motor.is_symlink()
    assert not socket.exists()
