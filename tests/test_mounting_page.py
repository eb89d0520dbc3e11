"""docs/mounting.md: its example does what it says, and its drawing is that of the nominal head."""
from pathlib import Path
import re
import subprocess
import sys

PAGE = (Path(__file__).resolve().parents[1] / 'docs' / 'mounting.md').read_text()
SNIPPET, EXAMPLE = re.findall(r'```python\n(.*?)```', PAGE, re.S)
CHECK = """
flange_optical = flange_head @ chain(static_transforms(head), 'ps_head_camera_optical_frame')
given = flange_head
{snippet}
assert np.allclose(flange_head, given)
"""


def test_example_prints_what_the_page_says(tmp_path: Path) -> None:
    printed = re.search(r'```\n(in ps_head_plane.*?)```', PAGE, re.S)
    assert printed is not None
    script = tmp_path / 'example.py'
    script.write_text(EXAMPLE + CHECK.format(snippet=SNIPPET))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60,
                          check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed[1]
