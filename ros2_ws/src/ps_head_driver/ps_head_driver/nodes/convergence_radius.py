"""Node convergence_radius: CR from motor counts and back, for the head as calibrated."""
from rclpy.node import Node

from ps_head_driver import ros_support
from ps_head_driver.calibration_file import apply
from ps_head_driver.convergence_radius import Branch, CrSolver
from ps_head_driver.conversions import light_to_message, message_to_calibration
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.head_model import APPROACHES, HeadModel, load_head, nominal_head_path
from ps_head_driver.kinematics import lights_at
from ps_head_driver.ros_support import Parameter, answers
from ps_interfaces import msg as ps
from ps_interfaces.srv import SolveConvergenceRadius

PARAMETERS = [
    Parameter('head_file', '', 'Head geometry (YAML); empty: the nominal head', read_only=True),
    Parameter('approach', 'up', "Last direction of the moves; as head_driver's", read_only=True,
              choices=APPROACHES),
]


class ConvergenceRadius(Node):
    """See the README for the service and parameters."""

    def __init__(self) -> None:
        super().__init__('convergence_radius')
        self.parameters = ros_support.Parameters(self, PARAMETERS, ErrorCode.CR_BAD_REQUEST)
        self._drawn = load_head(self.parameters['head_file'] or nominal_head_path())
        self.calibration_id = ''
        self.solved = self.refused = 0
        self._use(self._drawn)
        self.create_subscription(
            ps.HeadCalibration, 'calibration', self._on_calibration, ros_support.LATCHED)
        self.create_service(SolveConvergenceRadius, 'solve_convergence_radius', self._on_solve)
        ros_support.Diagnostics(self, {'Solver': self._diagnose})

    def _use(self, head: HeadModel) -> None:
        solver = CrSolver(head)
        solver.reachable(Branch.ANY)      # the slow part, and the compiler's, before any request
        self.head = head
        self._solvers = {0.0: solver}

    def _on_calibration(self, message: ps.HeadCalibration) -> None:
        try:
            self._use(apply(self._drawn, message_to_calibration(message),
                            self.parameters['approach']))
            self.calibration_id = message.calibration_id
        except PsError as error:
            self.get_logger().error(f'calibration refused: {error.message}')

    def _solver(self, light_height: float) -> CrSolver:
        if light_height not in self._solvers:
            # the head's own height and the last one asked for: a client asks for the same again
            self._solvers = {0.0: self._solvers[0.0],
                             light_height: CrSolver(self.head, light_height)}
        return self._solvers[light_height]

    @answers(ErrorCode.CR_INTERNAL)
    def _on_solve(self, request: SolveConvergenceRadius.Request,
                  response: SolveConvergenceRadius.Response) -> str:
        self.refused += 1
        solver = self._solver(request.light_height)
        if request.mode == request.FORWARD:
            solution = solver.forward(request.motor_counts)
        elif request.mode == request.INVERSE:
            if request.branch not in (Branch.ANY, Branch.UNCROSSED, Branch.CROSSED):
                raise PsError(ErrorCode.CR_BAD_REQUEST,
                              f'branch: {request.branch} is not ANY, UNCROSSED or CROSSED')
            branch = Branch(request.branch)
            low, high = solver.reachable(branch)
            response.reachable_min, response.reachable_max = low, high
            solution = solver.inverse(request.convergence_radius, branch)
        else:
            raise PsError(ErrorCode.CR_BAD_REQUEST,
                          f'mode: {request.mode} is neither FORWARD nor INVERSE')
        response.motor_counts, response.tilt = solution.motor_counts, solution.tilt
        response.convergence_radius = solution.convergence_radius
        response.light_height, response.residual = solution.light_height, solution.residual
        response.center_offset_x, response.center_offset_y = solution.center
        response.branch, response.dcr_dm = int(solution.branch), solution.dcr_dm
        response.reachable_min, response.reachable_max = solution.reachable
        dark_field_tilt = self.head.dark_field.tilt_range[0]
        response.lights = [light_to_message(light) for light in lights_at(
            self.head, solution.motor_counts, dark_field_tilt)[:4]]
        self.refused -= 1
        self.solved += 1
        if solution.branch is Branch.MIXED:
            return 'MIXED: the panels of this head disagree on the branch; no guarantee holds'
        return 'ok'

    def _diagnose(self) -> ros_support.Report:
        return ros_support.OK, 'ready', {
            'solved': self.solved, 'refused': self.refused, 'head': self.head.name,
            'calibration': self.calibration_id or 'none'}


def main() -> None:
    """Run the node."""
    ros_support.run_node(ConvergenceRadius)


if __name__ == '__main__':
    main()
