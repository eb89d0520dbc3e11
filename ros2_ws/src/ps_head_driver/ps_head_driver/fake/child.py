"""The fake head as a child process of the driver."""
from pathlib import Path
import select
import subprocess
import sys
import time

from ps_head_driver.errors import ErrorCode, PsError

START_S = 20.0
STOP_S = 2.0


class EmulatorChild:
    """Starts emulator_process, watches that it runs and ends it.

    The child ends by itself soon after this process has died, whatever killed it.

    :param trigger_socket: also names the fake serial port: the same path with the suffix .tty.
    :param head_file: geometry of the head as it really is.
    """

    def __init__(self, trigger_socket: Path, head_file: str) -> None:
        self.port = trigger_socket.with_suffix('.tty')
        self._command = [
            sys.executable, '-m', 'ps_head_driver.fake.emulator_process', '--die-with-stdin',
            '--port', str(self.port), '--trigger-socket', str(trigger_socket),
            '--head', head_file]
        self._process: subprocess.Popen | None = None

    def ensure(self) -> None:
        """Start it unless it runs.

        :raises PsError: HEAD_DISCONNECTED if it does not come up.
        """
        if self._process is not None and self._process.poll() is None:
            return
        self.stop()
        # a session of its own: Ctrl-C must reach the driver first, which then stops the head
        process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   start_new_session=True)
        self._process = process
        assert process.stdout is not None
        deadline = time.monotonic() + START_S
        while process.poll() is None and time.monotonic() < deadline:
            if select.select([process.stdout], [], [], 0.1)[0] and process.stdout.readline():
                return
        self.stop()
        raise PsError(ErrorCode.HEAD_DISCONNECTED, 'the fake head did not start; see its message '
                                                   'above')

    def stop(self) -> None:
        """End it."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
