"""Node reconstruction: stacks in, surface images out; always the newest stack first."""
from concurrent import futures
import dataclasses
import threading
import time
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from ps_head_driver import ros_support
from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.ros_support import Parameter
from ps_head_driver.stack import Stack
from ps_interfaces import msg as ps
from ps_reconstruction import pipeline
from ps_reconstruction.conversions import (
    IMAGE_TOPICS,
    camera_info_of,
    info_to_message,
    quantity_to_message,
)
from ps_reconstruction.pipeline import (
    FORMS,
    METHODS,
    OUTPUTS,
    TRUSTS,
    Options,
    Reconstruction,
)

PARAMETERS = [
    Parameter('method', 'ls', 'Solver', choices=METHODS),
    Parameter('trust', 'auto', 'How far stv departs from least squares; auto: chosen for every '
              'stack', choices=TRUSTS),
    Parameter('patch', 5, 'Width of the neighbourhood of stv, odd; 1: none', 'px', 1, 15),
    Parameter('near_field', True, 'Light vectors per pixel from the panel geometry; false: '
              'distant lights'),
    Parameter('height_rounds', 2, 'Alternations of height and lighting; 0: lights on the plane',
              '', 0, 10),
    Parameter('outputs', '', 'Comma-separated quantities computed and sent even without a '
              'subscriber: ' + ', '.join(OUTPUTS)),
    Parameter('careful', False, 'Integrate with confidence weights and height steps (slower)'),
    Parameter('form', 'auto', 'Form removed from the height; auto: slow where the lights are '
              'assumed, else none', choices=FORMS),
    Parameter('bits', 0, 'Bits that count of a pixel in 16, for cameras with 10, 12 or 14; 0: all '
              'of the pixel type', 'bit', 0, 16),
    Parameter('saturation', 0.98, 'Share of full scale that counts as saturated', '', 0.1, 1.0),
    Parameter('smoothness', 1.0, 'Smoothing of shape and curvature (sigma)', 'px', 0.0, 50.0),
    Parameter('flattening', 0.0, 'Length beyond which form is removed from the shape; 0: a 150th '
              'of the longer side', 'px', 0.0, 10000.0),
    Parameter('contrast', 1.0, 'Contrast of the shape', '', 0.01, 100.0),
    Parameter('s_filter', 0.0, 'Roughness S-filter nesting index; 0: none', 'm', 0.0, 0.1),
    Parameter('l_filter', 0.0008, 'Roughness L-filter nesting index', 'm', 1e-6, 0.1),
    Parameter('pixel_pitch', 0.0, 'Pixel distance of stacks without intrinsics; 0: unknown, '
              'heights are in pixels', 'm', 0.0, 0.1),
]
OPTION_NAMES = tuple(field.name for field in dataclasses.fields(Options))


class ReconstructionNode(Node):
    """See the README for topics and parameters."""

    def __init__(self) -> None:
        super().__init__('reconstruction')
        self.done = self.failed = self.dropped = 0
        self.elapsed = float('nan')        # s, of the last stack
        self.last: ps.ReconstructionInfo | None = None
        self._waiting: ps.PhotometricStack | None = None
        self._wake = threading.Condition()
        self._open = True
        self.parameters = ros_support.Parameters(
            self, PARAMETERS, ErrorCode.RECONSTRUCTION_BAD_PARAMETER, self._check_change)
        self._check_change({})
        self._images = {
            name: self.create_publisher(Image, topic, ros_support.RELIABLE,
                                        qos_overriding_options=ros_support.OVERRIDABLE)
            for name, topic in IMAGE_TOPICS.items()}
        self._cameras = {
            name: self.create_publisher(
                CameraInfo, topic.replace('/image', '/camera_info'), ros_support.RELIABLE)
            for name, topic in IMAGE_TOPICS.items() if topic.endswith('/image')}
        self._info = self.create_publisher(
            ps.ReconstructionInfo, 'reconstruction_info', ros_support.LATCHED)
        self.create_subscription(
            ps.PhotometricStack, 'stack', self._on_stack, ros_support.RELIABLE,
            qos_overriding_options=ros_support.OVERRIDABLE)
        ros_support.Diagnostics(self, {'Reconstruction': self._diagnose})
        # one thread for good: the memory it has touched stays its own
        self._sender = futures.ThreadPoolExecutor(1, thread_name_prefix='ps_publish')
        self._worker = threading.Thread(target=self._work, name='ps_reconstruction', daemon=True)
        self._worker.start()

    def _options(self, changes: dict[str, Any]) -> Options:
        return Options(**{
            name: changes.get(name, self.parameters[name]) for name in OPTION_NAMES})

    def _check_change(self, changes: dict[str, Any]) -> None:
        self._options(changes)
        _names(changes.get('outputs', self.parameters['outputs']))

    def _on_stack(self, message: ps.PhotometricStack) -> None:
        with self._wake:
            if self._waiting is not None:
                self.dropped += 1
                self.get_logger().warning(
                    f'stack {self._waiting.stack_id} is dropped for a newer one')
            self._waiting = message
            self._wake.notify()

    def _work(self) -> None:
        # compiled before the first stack comes, not while it waits
        start = time.perf_counter()
        try:
            pipeline.warm_up(self.parameters['method'])
        except Exception as error:
            # the stacks to come will say the same in their answers
            ros_support.as_ps_error(self, error, ErrorCode.RECONSTRUCTION_INTERNAL)
        self.get_logger().info(f'ready, kernels compiled in {time.perf_counter() - start:.1f} s')
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting is not None or not self._open)
                if not self._open:
                    return
                message, self._waiting = self._waiting, None
            try:
                self._process(message)
            except Exception as error:
                # a bad stack or a shutdown in the middle must not end the node
                if self._open:
                    ros_support.as_ps_error(self, error, ErrorCode.RECONSTRUCTION_INTERNAL)

    def _process(self, message: ps.PhotometricStack) -> None:
        method = self.parameters['method']
        result, failure = None, None
        wanted = self._wanted()
        start = time.perf_counter()
        try:
            stack = message_to_stack(message)
            converted = time.perf_counter() - start
            options = self._options({})
            method = options.method
            result = self._reconstruct_and_publish(message, stack, options, wanted)
            result.timings['convert'] = converted
            self.done += 1
        except Exception as error:
            result = None
            failure = ros_support.as_ps_error(self, error, ErrorCode.RECONSTRUCTION_INTERNAL)
            self.failed += 1
            self.get_logger().warning(
                f'stack {message.stack_id}: {failure.code.name}: {failure.message}')
        self.elapsed = time.perf_counter() - start
        self.last = info_to_message(message, result, failure, method, self.dropped)
        self._info.publish(self.last)

    def _wanted(self) -> set[str]:
        """Quantities that somebody listens to or the parameter names."""
        wanted = _names(self.parameters['outputs'])
        for name, publisher in (*self._images.items(), *self._cameras.items()):
            if publisher.get_subscription_count():
                wanted.add(name)
        return wanted

    def _reconstruct_and_publish(self, message: ps.PhotometricStack, stack: Stack,
                                 options: Options, wanted: set[str]) -> Reconstruction:
        """Publish every image as soon as there is one, while the next are computed."""
        camera_info = camera_info_of(message)
        sent: list[futures.Future[float]] = []

        def publish(result: Reconstruction, name: str) -> float:
            start = time.perf_counter()
            self._images[name].publish(quantity_to_message(result, name, message.header))
            if name in self._cameras:
                self._cameras[name].publish(camera_info)
            return time.perf_counter() - start

        try:
            result = pipeline.reconstruct(
                stack, options, wanted,
                lambda result, name: sent.append(self._sender.submit(publish, result, name)))
        finally:
            futures.wait(sent)
        result.timings['publish'] = sum(each.result() for each in sent)
        return result

    def _diagnose(self) -> ros_support.Report:
        values = {'stacks done': self.done, 'stacks failed': self.failed,
                  'stacks dropped': self.dropped, 'method': self.parameters['method']}
        if self.last is None:
            return ros_support.OK, 'waiting for a stack', values
        values['last stack'] = self.last.stack_id
        values['valid fraction'] = f'{self.last.valid_fraction:.4f}'
        values['time, s'] = f'{self.elapsed:.3f}'
        if not self.last.success:
            return ros_support.ERROR, self.last.message, values
        if self.dropped:
            return ros_support.WARN, f'{self.dropped} stacks dropped for newer ones', values
        return ros_support.OK, 'ok', values

    def close(self) -> None:
        """End the worker; a stack in work is finished first."""
        with self._wake:
            self._open = False
            self._wake.notify()
        self._worker.join(timeout=5.0)
        self._sender.shutdown()


def _names(text: str) -> set[str]:
    names = {name.strip() for name in text.split(',')} - {''}
    if names - set(OUTPUTS):
        raise PsError(ErrorCode.RECONSTRUCTION_BAD_PARAMETER,
                      f'parameter outputs: {", ".join(sorted(names - set(OUTPUTS)))}: not among '
                      + ', '.join(OUTPUTS))
    return names


def main() -> None:
    """Run the node."""
    ros_support.run_node(ReconstructionNode)


if __name__ == '__main__':
    main()
