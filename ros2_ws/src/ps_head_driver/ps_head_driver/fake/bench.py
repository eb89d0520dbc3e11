"""A fake head in a thread, behind a real pseudo-terminal, for tests of the link and the client."""
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import threading

from ps_head_driver.fake.emulator_process import FakeHead
from ps_head_driver.fake.trigger_socket import ControlClient
from ps_head_driver.head_model import load_head, nominal_head_path


@contextmanager
def fake_head(folder: Path, boards: int = 1) -> Iterator[tuple[list[str], ControlClient]]:
    """Ports of the boards, and the channel that injects faults."""
    ports = [folder / f'port{i}' for i in range(boards)]
    path = nominal_head_path()
    fake = FakeHead(load_head(path), str(path), ports[0], folder / 'trigger.sock',
                    lights_port=ports[1] if boards == 2 else None)
    done = threading.Event()
    thread = threading.Thread(target=fake.run, args=(done.is_set, []))
    thread.start()
    try:
        with ControlClient(folder / 'trigger.sock') as control:
            control.command('state')
            yield [str(port) for port in ports], control
    finally:
        done.set()
        thread.join()
        fake.close()
