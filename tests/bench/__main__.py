"""Run every tests/bench/bench_*.py, or those named: `python -m tests.bench stv`."""
import importlib.util
from pathlib import Path
import sys


def run(path: Path) -> None:
    """Load one benchmark file by its path and call its main(), which prints one table."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    print(f'\n== {path.stem.removeprefix("bench_")}: {(module.__doc__ or "").splitlines()[0]}')
    module.main()


def main() -> int:
    """Run the benchmarks named on the command line, all without one; 1 if a name fits none."""
    wanted = sys.argv[1:]
    found = sorted(Path(__file__).parent.glob('bench_*.py'))
    chosen = [path for path in found if not wanted or path.stem.removeprefix('bench_') in wanted]
    if not chosen:
        names = ', '.join(path.stem.removeprefix('bench_') for path in found)
        print(f'no such benchmark; there are: {names}', file=sys.stderr)
        return 1
    for path in chosen:
        run(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
