"""From strobe to images, as real processes over DDS with fake hardware, split by stage."""
from pathlib import Path
import statistics
import tempfile

from rich.console import Console
from rich.table import Table
import yaml

from ps_head_driver.camera_model import scaled_camera
from ps_head_driver.head_model import load_head, nominal_head_path
from ps_inspection.cell_client import KEPT, CellClient
from ps_inspection.runner import Cell
from ps_reconstruction.conversions import IMAGE_TOPICS

SIZES = ((1280, 1024, 9), (2448, 2048, 5))     # pixels, mono8; captures
WARM_UP = KEPT + 1                             # captures, until the client uses its memory again
CASES = {'slope': ['slope'], 'all images': list(IMAGE_TOPICS)}


def captured(client: CellClient) -> dict[str, float]:
    """Take one stack and say what each part of its way took, s."""
    stack_id = client.capture(timeout=120.0)
    message = client.stack(stack_id)
    info, _ = client.reconstruction(stack_id)
    stamp = (info.header.stamp.sec, info.header.stamp.nanosec)
    last = max(images[stamp][1] for images in client.images.values())
    times = [light.device_time_ns for light in message.lights]
    return {
        'first strobe to end of last exposure (board clock)':
            (times[-1] - times[0]) * 1e-9 + message.lights[-1].exposure_time,
        'stack received to last image received': last - client.stacks[stack_id][1],
        **{f'  {d.stage}': d.duration for d in info.durations}}


def measure(width_px: int, height_px: int, captures: int) -> dict[str, dict[str, float]]:
    """Medians in seconds of each of the CASES, after some captures to warm up."""
    results = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        head = load_head(nominal_head_path())
        camera = scaled_camera(head.camera, width_px, height_px)
        head_file = folder / 'head.yaml'
        head_file.write_text(yaml.safe_dump(
            head.model_copy(update={'camera': camera}).model_dump(mode='json')))
        arguments = {'fake_hardware': 'true', 'camera': 'fake', 'scene': 'disc',
                     'head_file': str(head_file), 'session_folder': str(folder)}
        with Cell(arguments, log_folder=folder / 'logs'):
            for case, outputs in CASES.items():
                with CellClient(outputs=outputs) as client:
                    client.home()
                    client.illuminate(0.06)
                    client.wait_for_outputs()
                    rows = [captured(client) for _ in range(WARM_UP + captures)][WARM_UP:]
                results[case] = {stage: statistics.median(row[stage] for row in rows)
                                 for stage in rows[-1]}
    return results


def main() -> None:
    """Print one table; rendering is not part of it."""
    results = {f'{width} x {height}, {case}': result for width, height, captures in SIZES
               for case, result in measure(width, height, captures).items()}
    table = Table('stage, ms', *results, title='strobe to image, median; images are published '
                  'while the next are computed')
    for stage in dict.fromkeys(stage for result in results.values() for stage in result):
        table.add_row(stage, *(f'{result[stage] * 1e3:.1f}' if stage in result else ''
                               for result in results.values()))
    Console().print(table)


if __name__ == '__main__':
    main()
