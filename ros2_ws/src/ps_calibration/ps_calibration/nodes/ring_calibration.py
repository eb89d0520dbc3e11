"""Node ring_calibration: holds, saves and loads the active calibration."""
from pathlib import Path

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from ps_head_driver import ros_support
from ps_head_driver.calibration_file import HeadCalibration, read_calibration, write_calibration
from ps_head_driver.conversions import calibration_to_message
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import Parameter, answers
from ps_interfaces import msg as ps
from ps_interfaces.action import CalibrateRing
from ps_interfaces.srv import CalibrationFile

PARAMETERS = [
    Parameter('calibration_folder', '~/.ps_head/calibration',
              'Folder of calibration files; relative names in requests are in it', read_only=True),
    Parameter('calibration_file', '', 'Calibration made active at start; empty: none, nominal '
              'geometry', read_only=True),
    Parameter('head_serial', '', 'Refuse calibrations of other heads; empty: the serial number '
              'that head_status reports'),
]


class RingCalibration(Node):
    """See the README for topics, services, the action and parameters."""

    def __init__(self) -> None:
        super().__init__('ring_calibration')
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.CALIBRATION_BAD_REQUEST)
        self.folder = Path(self.parameters['calibration_folder']).expanduser()
        self.active: HeadCalibration | None = None
        self.reported_serial = ''
        self.refused = ''      # why the calibration of the start was dropped
        self._publisher = self.create_publisher(
            ps.HeadCalibration, 'calibration', ros_support.LATCHED)
        self.create_subscription(
            ps.HeadStatus, 'head_status', self._on_head_status, ros_support.LATCHED)
        self.create_service(CalibrationFile, '~/save', self._on_save)
        self.create_service(CalibrationFile, '~/load', self._on_load)
        self._action = ActionServer(
            self, CalibrateRing, 'calibrate_ring', self._on_calibrate,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT)
        ros_support.Diagnostics(self, {'Calibration': self._diagnose},
                                hardware_id=lambda: self.reported_serial)
        if self.parameters['calibration_file']:
            self._activate(self._path(self.parameters['calibration_file']))
        self._publish()

    def _on_head_status(self, message: ps.HeadStatus) -> None:
        self.reported_serial = message.serial_number or self.reported_serial
        try:
            if self.active is not None:
                self._check_serial(self.active)
        except PsError as error:
            # loaded before the head had said who it is
            self.get_logger().error(f'{error.message}; nominal geometry is active instead')
            self.active, self.refused = None, error.message
            self._publish()

    def _path(self, name: str) -> Path:
        """File of a request.

        :raises PsError: CALIBRATION_BAD_REQUEST for an empty name or one that climbs out.
        """
        if not name:
            raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST, 'file: empty; give a file name')
        path = Path(name).expanduser()
        if path.is_absolute():
            return path
        inside = (self.folder / path).resolve()
        if not inside.is_relative_to(self.folder.resolve()):
            raise PsError(ErrorCode.CALIBRATION_BAD_REQUEST,
                          f'file: {name} leaves the calibration folder {self.folder}')
        return inside

    @answers(ErrorCode.CALIBRATION_INTERNAL)
    def _on_save(self, request: CalibrationFile.Request,
                 response: CalibrationFile.Response) -> str:
        if self.active is None:
            raise PsError(ErrorCode.CALIBRATION_NONE_ACTIVE,
                          'no calibration is active; calibrate or load one first')
        path = self._path(request.file)
        write_calibration(self.active, path)
        response.calibration_id = self.active.calibration_id
        return f'written to {path}'

    @answers(ErrorCode.CALIBRATION_INTERNAL)
    def _on_load(self, request: CalibrationFile.Request,
                 response: CalibrationFile.Response) -> str:
        path = self._path(request.file)
        self._activate(path)
        self._publish()
        assert self.active is not None
        response.calibration_id = self.active.calibration_id
        return f'{path} is active'

    def _activate(self, path: Path) -> None:
        """Read a file and make it active; what was active before stays if it is refused.

        :raises PsError: CALIBRATION_* with the reason.
        """
        calibration = read_calibration(path)
        self._check_serial(calibration)
        if calibration.verdict == 'FAILED':
            raise PsError(ErrorCode.CALIBRATION_FILE_INVALID,
                          f'{path}: this calibration failed: {calibration.verdict_reason}')
        self.active, self.refused = calibration, ''

    def _check_serial(self, calibration: HeadCalibration) -> None:
        ours = self.parameters['head_serial'] or self.reported_serial
        if ours and calibration.head_serial != ours:
            raise PsError(ErrorCode.CALIBRATION_WRONG_HEAD,
                          f'calibration {calibration.calibration_id} was made for head '
                          f'{calibration.head_serial!r}, this is {ours!r}')

    def _on_calibrate(self, goal: ServerGoalHandle) -> CalibrateRing.Result:
        result = CalibrateRing.Result(verdict=ps.HeadCalibration.VERDICT_FAILED)
        ros_support.fill_error(result, PsError(
            ErrorCode.CALIBRATION_NOT_IMPLEMENTED,
            'the half-ring calibration is not part of this version; load a calibration file with '
            'ring_calibration/load, or work with nominal geometry'))
        result.reason = result.message
        goal.abort()
        return result

    def _publish(self) -> None:
        self._publisher.publish(calibration_to_message(self.active))

    def _diagnose(self) -> ros_support.Report:
        if self.refused:
            return ros_support.ERROR, self.refused, {}
        if self.active is None:
            return ros_support.WARN, 'not calibrated: nominal geometry', {}
        level = ros_support.OK if self.active.verdict == 'OK' else ros_support.WARN
        return level, f'{self.active.verdict} {self.active.verdict_reason}'.strip(), {
            'calibration': self.active.calibration_id, 'created': self.active.created,
            'target': self.active.target_name, 'head': self.active.head_serial}


def main() -> None:
    """Run the node."""
    ros_support.run_node(RingCalibration)


if __name__ == '__main__':
    main()
