"""Set-up, env.sh, container files: what can be checked without an empty machine."""
import importlib.metadata
import importlib.util
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / 'ros2_ws' / 'src'
PACKAGES = sorted(path.parent for path in SOURCE.glob('*/package.xml'))
NUMPY_BOUND = {'contourpy', 'llvmlite', 'matplotlib', 'numba', 'numpy', 'opencv-python-headless',
               'scipy'}  # older with the numpy 1.26 of Ubuntu 24.04

_spec = importlib.util.spec_from_file_location('project_setup', ROOT / 'scripts' / 'setup.py')
assert _spec is not None
assert _spec.loader is not None
project_setup = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(project_setup)
SetupError = project_setup.SetupError


def pins(name: str) -> dict[str, str]:
    """Read name -> version from a requirements file; every line must be an exact pin."""
    found = {}
    for line in (ROOT / 'requirements' / name).read_text(encoding='utf-8').splitlines():
        if line.strip() and not line.startswith('#'):
            match = re.fullmatch(r'([a-z0-9-]+)==([\w.]+)(\s+#.*)?', line)
            assert match, f'{name}: {line!r} is no exact pin'
            found[match[1]] = match[2]
    return found


def installed() -> dict[str, str]:
    return {re.sub(r'[-_.]+', '-', one.metadata['Name']).lower(): one.version
            for one in importlib.metadata.distributions()}


# ---------------------------------------------------------------------------- answers of set-up

def fake_python(folder: Path, name: str, version: str, **having: bool) -> None:
    """Make an executable that answers set-up's question as the wanted Python would."""
    answer = json.dumps({'version': [int(part) for part in version.split('.')],
                         'executable': str(folder / name), 'include': '/none', **having})
    (folder / name).write_text(f"#!/bin/sh\necho '{answer}'\n")
    (folder / name).chmod(0o755)


@pytest.fixture
def only_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all of PATH."""
    monkeypatch.setenv('PATH', str(tmp_path))
    monkeypatch.delenv('CC', raising=False)
    monkeypatch.delenv('CXX', raising=False)
    return tmp_path


def test_first_python_that_fits_is_taken(only_path: Path) -> None:
    fake_python(only_path, 'python3', '3.9', venv=True, headers=True)
    fake_python(only_path, 'python3.11', '3.11', venv=True, headers=False)
    fake_python(only_path, 'python3.12', '3.12', venv=True, headers=True)
    chosen = project_setup.choose_python(None, ['python3', 'python3.11', 'python3.12'])
    assert chosen['version'] == [3, 12]


@pytest.mark.parametrize(('version', 'venv', 'headers', 'answer'), [
    ('3.9', True, True, 'Python 3.11 to 3.14 is needed, found 3.9'),
    ('3.15', True, True, 'Python 3.11 to 3.14 is needed, found 3.15'),
    ('3.11', False, True, 'sudo apt install python3.11-venv'),
    ('3.12', True, False, 'sudo apt install python3.12-dev'),
])
def test_unfit_python_is_named(only_path: Path, version: str, venv: bool, headers: bool,
                               answer: str) -> None:
    fake_python(only_path, 'python3', version, venv=venv, headers=headers)
    with pytest.raises(SetupError, match=re.escape(answer)):
        project_setup.choose_python(None, ['python3'])


def test_no_python_and_wrong_name(only_path: Path) -> None:
    with pytest.raises(SetupError, match='found none'):
        project_setup.choose_python(None, ['python3'])
    with pytest.raises(SetupError, match='PYTHON=python9 does not run'):
        project_setup.choose_python('python9', ['python3'])


def test_missing_compilers_are_named(only_path: Path) -> None:
    with pytest.raises(SetupError, match=r'no C compiler found: sudo apt install build-essential'):
        project_setup.check_tools()
    fake_python(only_path, 'gcc', '3.11', venv=True, headers=True)  # anything executable
    with pytest.raises(SetupError, match=r'no C\+\+ compiler'):
        project_setup.check_tools()


@pytest.mark.parametrize(('system', 'machine', 'libc', 'answer'), [
    ('Linux', 'aarch64', ('glibc', '2.36'), 'Linux x86_64 only, this is Linux aarch64'),
    ('Darwin', 'x86_64', ('', ''), 'this is Darwin x86_64'),
    ('Linux', 'x86_64', ('', ''), 'another libc'),
    ('Linux', 'x86_64', ('glibc', '2.17'), 'glibc 2.17'),
])
def test_unsupported_machine(system: str, machine: str, libc: tuple[str, str],
                             answer: str) -> None:
    with pytest.raises(SetupError, match=re.escape(answer)):
        project_setup.check_platform(system, machine, libc)


def test_supported_machine() -> None:
    project_setup.check_platform('Linux', 'x86_64', ('glibc', '2.28'))
    project_setup.check_disk(project_setup.FREE_BYTES)
    with pytest.raises(SetupError, match=r'1\.0 GB free'):
        project_setup.check_disk(2**30)


def ros_prefix(folder: Path) -> Path:
    (folder / 'share' / 'rclpy').mkdir(parents=True)
    (folder / 'share' / 'rclpy' / 'package.xml').touch()
    return folder


def test_sourced_ros_is_found_and_must_be_jazzy(tmp_path: Path) -> None:
    prefix = ros_prefix(tmp_path / 'ros')
    path = f'{tmp_path / "overlay"}:{prefix}'
    environ = {'AMENT_PREFIX_PATH': path, 'ROS_DISTRO': 'jazzy'}
    assert project_setup.sourced_ros(environ) == prefix
    with pytest.raises(SetupError, match='ROS 2 humble is sourced, this project needs jazzy'):
        project_setup.sourced_ros(environ | {'ROS_DISTRO': 'humble'})


def test_own_environment_is_no_sourced_ros(tmp_path: Path) -> None:
    venv = ros_prefix(tmp_path / 'venv')
    (venv / 'pyvenv.cfg').touch()
    path = f'{project_setup.VENV}:{venv}'
    assert project_setup.sourced_ros({'AMENT_PREFIX_PATH': path}) is None
    assert project_setup.sourced_ros({'ROS_DISTRO': 'jazzy'}) is None


@pytest.mark.parametrize(('output', 'answer'), [
    ('x\nOSError: [Errno 28] No space left on device\n', 'the disk is full'),
    ('WARNING: Retrying after NewConnectionError(...)\nERROR: No matching distribution found\n',
     'is there a network'),
    ('a\nERROR: No matching distribution found for x==1\n', 'ERROR: No matching distribution'),
    ('/a/b.cpp:3:1: error: expected x\nmake: *** stop\n', 'b.cpp:3:1: error: expected x'),
    ('only this\n\n', 'only this'),
])
def test_failed_command_becomes_one_line(output: str, answer: str) -> None:
    line = project_setup.reason(output)
    assert answer in line
    assert '\n' not in line


def test_main_says_one_line_and_fails(monkeypatch: pytest.MonkeyPatch,
                                      capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise SetupError('no such thing')
    monkeypatch.setattr(project_setup, 'setup', fail)
    assert project_setup.main() == 1
    assert capsys.readouterr().err == 'setup: no such thing\n'


def test_broken_stamp_counts_as_none(tmp_path: Path) -> None:
    stamp = tmp_path / 'setup.json'
    assert project_setup.read_stamps(stamp) == {}
    stamp.write_text('{"packages": "ab')
    assert project_setup.read_stamps(stamp) == {}


def test_stamps_follow_descriptions_not_code(tmp_path: Path,
                                             monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(SOURCE / 'ps_interfaces', tmp_path / 'src' / 'ps_interfaces')
    shutil.copytree(SOURCE / 'ps_calibration', tmp_path / 'src' / 'ps_calibration')
    monkeypatch.setattr(project_setup, 'WORKSPACE', tmp_path)
    before = project_setup.workspace_stamps('base')
    (tmp_path / 'src/ps_calibration/ps_calibration/new.py').write_text('x = 1\n')
    assert project_setup.workspace_stamps('base') == before
    (tmp_path / 'src/ps_calibration/config/new.yaml').write_text('a: 1\n')
    after = project_setup.workspace_stamps('base')
    assert after['python'] != before['python']
    assert after['interfaces'] == before['interfaces']
    (tmp_path / 'src/ps_interfaces/msg/Panel.msg').write_text('uint8 x\n')
    assert project_setup.workspace_stamps('base')['interfaces'] != before['interfaces']


def test_kernels_are_compiled_anew_when_any_source_changed(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(project_setup, 'WORKSPACE', tmp_path)
    monkeypatch.setattr(project_setup, 'KERNELS', tmp_path / 'numba')
    (tmp_path / 'src').mkdir()
    kernel, other = tmp_path / 'src' / 'kernel.py', tmp_path / 'src' / 'other.py'
    kernel.write_text('@nb.njit(cache=True)\ndef f(x):\n    return x\n')
    other.write_text('x = 1\n')
    compiled = tmp_path / 'numba' / 'folder' / 'kernel.f.nbi'
    for changed, text, kept in ((other, 'x = 2\n', True),
                                (kernel, kernel.read_text() + '# more\n', False)):
        project_setup.forget_kernels()
        compiled.parent.mkdir(parents=True, exist_ok=True)
        compiled.touch()
        changed.write_text(text)
        project_setup.forget_kernels()
        assert compiled.exists() == kept


@pytest.mark.parametrize(('finished', 'fresh', 'kept'),
                         [(True, False, True), (True, True, False), (False, False, False)])
def test_builds_of_others_are_not_built_upon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                             finished: bool, fresh: bool, kept: bool) -> None:
    (tmp_path / 'src').mkdir()
    for name in ('build', 'install'):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'of_a_plain_colcon_build').touch()
    if finished:
        (tmp_path / 'install' / 'setup.json').write_text('{"interfaces": "old"}')
    monkeypatch.setattr(project_setup, 'WORKSPACE', tmp_path)
    monkeypatch.setattr(project_setup, 'build_environment', lambda ros: {})
    monkeypatch.setattr(project_setup, 'logged',
                        lambda *args, **named: (tmp_path / 'install').mkdir(exist_ok=True))
    project_setup.build_workspace(None, 'base', fresh)
    assert (tmp_path / 'build' / 'of_a_plain_colcon_build').exists() == kept
    assert project_setup.read_stamps(tmp_path / 'install' / 'setup.json')['interfaces'] != 'old'


def test_wheels_are_repaired_through_new_files(tmp_path: Path,
                                               monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(project_setup, 'VENV', tmp_path)
    numpy = tmp_path / 'lib/python3.11/site-packages/numpy/_core/include'
    numpy.mkdir(parents=True)
    cmake = tmp_path / 'share' / 'a' / 'a.cmake'
    cmake.parent.mkdir(parents=True)
    old = ('set(x "/opt/python/cp311-cp311/include/python3.11;'
           '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include")\n')
    cmake.write_text(old)
    os.link(cmake, tmp_path / 'cached')
    assert project_setup.repair_wheels(Path('/here/include')) == 1
    assert cmake.read_text() == f'set(x "/here/include;{numpy}")\n'
    assert (tmp_path / 'cached').read_text() == old
    assert project_setup.repair_wheels(Path('/here/include')) == 0


# ---------------------------------------------------------------------------- requirements

def test_locked_versions_are_the_installed_ones() -> None:
    if 'wheels' not in project_setup.read_stamps(ROOT / '.venv/setup.json').get('made_with', ''):
        pytest.skip('the environment was not made from the locks')
    have = installed()
    wanted = pins('ros.lock') | pins('runtime.lock') | pins('dev.lock')
    assert {name: have.get(name) for name in wanted} == wanted


def test_locks_do_not_overlap_and_agree_with_the_sourced_ones() -> None:
    names = [name for lock in ('ros.lock', 'runtime.lock', 'dev.lock') for name in pins(lock)]
    assert len(names) == len(set(names))
    locked = pins('ros.lock') | pins('runtime.lock') | pins('dev.lock')
    sourced = pins('sourced-ros.txt')
    needed = {**pins('runtime.lock'), **pins('dev.lock')}
    assert needed.keys() <= sourced.keys()
    differing = {name for name in sourced if sourced[name] != locked[name]}
    assert differing <= NUMPY_BOUND | {'pytest'}  # launch_testing wants an older pytest
    assert sourced['numpy'].startswith('1.26.')


def test_package_descriptions_are_valid() -> None:
    catkin_pkg = pytest.importorskip('catkin_pkg.package')
    for folder in PACKAGES:
        package = catkin_pkg.parse_package(str(folder / 'package.xml'))
        package.validate()
        assert package.licenses == ['Apache-2.0']


def test_every_declared_python_dependency_is_locked() -> None:
    distribution = {'opencv': 'opencv-python-headless', 'serial': 'pyserial', 'yaml': 'pyyaml'}
    locked = pins('ros.lock') | pins('runtime.lock') | pins('dev.lock')
    keys = {element.text or '' for folder in PACKAGES
            for element in ElementTree.parse(folder / 'package.xml').getroot()
            if element.tag.endswith('depend')}
    python = {key.removeprefix('python3-') for key in keys if key.startswith('python3-')}
    assert {'numpy', 'serial'} <= python
    assert {distribution.get(name, name) for name in python} <= locked.keys()
    # launch files and what they start are for a sourced ROS only
    ros = {f'ros-{key.replace("_", "-")}' for key in keys
           if not key.startswith(('python3-', 'ps_', 'launch', 'robot_state_publisher'))}
    assert ros <= locked.keys()


# ---------------------------------------------------------------------------- make, containers

def make_targets() -> set[str]:
    text = (ROOT / 'Makefile').read_text(encoding='utf-8')
    return set(re.findall(r'^([a-z]+):', text, re.M))


def test_named_make_targets_exist() -> None:
    targets = make_targets()
    assert {'help', 'setup', 'demo', 'test', 'lint', 'bench', 'clean'} <= targets
    named = re.findall(r'"make", "(\w+)"|make (\w+)', '\n'.join(
        (ROOT / path).read_text(encoding='utf-8').split('#', 1)[0] if path == 'env.sh'
        else (ROOT / path).read_text(encoding='utf-8')
        for path in ('docker/Dockerfile', 'docker/compose.yaml', '.ci/run')))
    used = {one or other for one, other in named}
    assert {'setup', 'demo', 'test'} <= used
    assert used - {'g'} <= targets


def test_ci_runs_and_help_lists_all() -> None:
    assert os.access(ROOT / '.ci/run', os.X_OK)
    text = subprocess.run(['make', '-C', str(ROOT), '-s', 'help'], capture_output=True, text=True,
                          check=True, timeout=20).stdout
    assert set(re.findall(r'make (\w+)', text)) >= make_targets()


def test_container_files_fit_together() -> None:
    compose = yaml.safe_load((ROOT / 'docker/compose.yaml').read_text(encoding='utf-8'))
    cell = compose['services']['cell']
    context = (ROOT / 'docker' / cell['build']['context']).resolve()
    assert context == ROOT
    dockerfile = (context / cell['build']['dockerfile']).read_text(encoding='utf-8')
    copied = re.findall(r'^COPY (\S+) ', dockerfile, re.M)
    assert copied
    assert all((ROOT / path).exists() for path in copied)
    assert dockerfile.index('FROM ros:jazzy') < dockerfile.index('make setup')
    assert 'CMD ["make", "demo"]' in dockerfile
    assert cell['command'] == 'make demo'
    ignored = (ROOT / '.dockerignore').read_text(encoding='utf-8').split()
    assert {'.git', '.venv*', 'ros2_ws/build', 'ros2_ws/install'} <= set(ignored)


def test_container_has_shared_memory_for_every_process() -> None:
    profile = ElementTree.parse(SOURCE / 'ps_inspection/config/fastdds.xml')
    segment = int(profile.findtext('.//{*}segment_size') or 0)
    cell = yaml.safe_load((ROOT / 'docker/compose.yaml').read_text())['services']['cell']
    shared = int(re.fullmatch(r'(\d+)gb', cell['shm_size'])[1]) * 2**30  # type: ignore[index]
    assert shared >= 12 * segment  # 7 nodes, the demo, a recorder, some tools


# ---------------------------------------------------------------------------- env.sh

def shells() -> list[str]:
    return [shell for shell in ('dash', 'bash', 'zsh') if shutil.which(shell)]


def plain_environment() -> dict[str, str]:
    return {'PATH': '/usr/local/bin:/usr/bin:/bin', 'HOME': str(Path.home())}


needs_setup = pytest.mark.skipif(
    not (ROOT / 'ros2_ws/install/setup.json').exists(), reason='make setup has not run here')


@needs_setup
@pytest.mark.parametrize('shell', shells())
def test_env_sh_is_idempotent_under_strict_options(shell: str) -> None:
    script = ('set -eu; . ./env.sh; env | sort > "$1"; . ./env.sh; env | sort > "$2"; '
              'for c in ps_cr ps_reconstruct ps_cell ps_demo python; do command -v $c; done; '
              'case $- in *e*u*|*u*e*) echo strict ;; esac')
    pair = [f'/tmp/ps_env_{os.getpid()}_{shell}_{n}' for n in (1, 2)]
    try:
        result = subprocess.run([shell, '-c', script, shell, *pair], cwd=ROOT, text=True,
                                capture_output=True, env=plain_environment(), timeout=60)
        assert result.returncode == 0, result.stderr
        first, second = (Path(path).read_text() for path in pair)
    finally:
        for path in pair:
            Path(path).unlink(missing_ok=True)
    assert first == second
    assert 'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST' in first
    assert 'fastdds.xml' in first
    assert 'MALLOC_MMAP_MAX_=0' in first
    assert '_ROS_WHEELS_BOOTSTRAP_COMPLETE' not in first
    lines = result.stdout.split()
    assert lines[-2:] == [str(ROOT / '.venv/bin/python'), 'strict']
    assert all(line.startswith(str(ROOT)) for line in lines[:-1])


@needs_setup
def test_env_sh_from_another_folder_keeps_what_the_user_set() -> None:
    environment = plain_environment() | {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
                                         'MALLOC_MMAP_MAX_': '7', 'NUMBA_CACHE_DIR': '/x'}
    script = (f'. {ROOT}/env.sh; echo $ROS_AUTOMATIC_DISCOVERY_RANGE $MALLOC_MMAP_MAX_ '
              '$NUMBA_CACHE_DIR; python -c "import rclpy, ps_interfaces.msg, ps_head_driver"')
    result = subprocess.run(['bash', '-c', script], cwd='/', capture_output=True, text=True,
                            env=environment, timeout=60)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == 'SUBNET 7 /x'


@pytest.mark.parametrize('shell', shells())
def test_env_sh_says_what_is_missing(shell: str, tmp_path: Path) -> None:
    shutil.copy(ROOT / 'env.sh', tmp_path)
    command = [shell, '-c', '. ./env.sh; echo "status $?"']
    lost = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=20)
    assert "is not the project's root" in lost.stderr
    (tmp_path / 'scripts').mkdir()
    (tmp_path / 'scripts' / 'setup.py').touch()
    bare = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=20)
    assert "run 'make setup'" in bare.stderr
    assert bare.stderr.count('\n') == 1
    assert bare.stdout == 'status 1\n'
