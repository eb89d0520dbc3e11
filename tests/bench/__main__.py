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
    """Run the benchmarks named on the command line, all without one; 1 if a name is unknown."""
    found = {path.stem.removeprefix('bench_'): path
             for path in sorted(Path(__file__).parent.glob('bench_*.py'))}
    wanted = sys.argv[1:] or list(found)
    unknown = [name for name in wanted if name not in found]
    if unknown:
        print(f'no benchmark {", ".join(unknown)}; there are: {", ".join(found)}', file=sys.stderr)
        return 1
    for name in wanted:
        run(found[name])
    return 0


if __name__ == '__main__':
    sys.exit(main())
