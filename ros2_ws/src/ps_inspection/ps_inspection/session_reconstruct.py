"""Every stack of a session again: here, in local processes, or on a Dask cluster."""
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields, replace
import json
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ps_head_driver.conversions import message_to_stack
from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.session_output import (
    IDENTITY_FIELDS,
    Outcome,
    claim,
    finish,
    identity,
    known,
    reason,
    stack_folder_name,
    whole_folder,
)
from ps_reconstruction.pipeline import Options, Reconstruction, reconstruct
from ps_reconstruction.result_files import write_arrays
from ps_reconstruction.session_format import STACK_TYPE, stack_id_of
from ps_reconstruction.session_reader import Place, Scan, Session, decode

FIGURES = ('method', 'near_field', 'metric', 'valid_fraction', 'residual_rms', 'sa', 'sq', 'sdq',
           'sdr', 'seconds')
INDEX_FIELDS = ('folder', *IDENTITY_FIELDS, *FIGURES, 'error')


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    :param processes: on this machine; 1: in this process.
    :param scheduler: address of a Dask scheduler, as in 'tcp://10.0.0.5:8786'; its workers must
        have this software and see session and output under the same paths.
    """

    processes: int = 1
    scheduler: str = ''


@dataclass(frozen=True)
class Job:
    """One stack to reconstruct; all that a worker needs to know.

    :param folder: to be made.
    """

    session: str
    place: Place
    folder: str
    options: Options


def reconstruct_session(
    session: Session, out: Path, method: str = '', workers: Workers = Workers(),
    progress: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Reconstruct every stack into ``<out>/<stack>/``: result.npz and stack.json; and index.csv.

    :param out: new or empty, or left by an interrupted run: what is done is not done again.
    :param method: in place of the recorded one.
    :raises PsError: SESSION_BAD_REQUEST if ``out`` holds something else or the workers cannot be
        reached; SESSION_INTERNAL if a local worker dies.
    :raises OSError: if the disk fails; a bad stack is reported and skipped.
    """
    claim(out, session)
    outcome, scan = Outcome(), Scan()
    stacks = [(stack_folder_name(number, stack_id_of(message.data)), message.place)
              for number, message in enumerate(session.stack_messages(scan))]
    options = recorded_options(scan)
    if method:
        options = replace(options, method=method)
    jobs = [Job(str(session.file.resolve()), place, str((out / name).resolve()), options)
            for name, place in stacks if not (out / name).is_dir()]
    outcome.skipped = len(stacks) - len(jobs)
    for number, (job, failure) in enumerate(_results(jobs, workers), 1):
        name = Path(job.folder).name
        if failure:
            outcome.failed[name] = failure
        else:
            outcome.done += 1
        progress(f'{number}/{len(jobs)} {name}' + (f': {failure}' if failure else ''))
    finish(out, INDEX_FIELDS, (
        {'folder': name, 'error': outcome.failed[name]} if name in outcome.failed
        else {'folder': name, **json.loads((out / name / 'stack.json').read_text())}
        for name, _ in stacks))
    outcome.problems = scan.problems
    return outcome


def recorded_options(scan: Scan) -> Options:
    """Options of the reconstruction node as they were when the session began.

    So a stack gives what it gave then, to the bit. What cannot be used is a problem of the scan.
    """
    options = Options()
    recorded = scan.metadata.get('parameters/reconstruction', {})
    for option in fields(Options):
        text = recorded.get(option.name)
        if text is None:
            continue
        kind: Any = type(option.default)
        try:
            value: Any = {'True': True, 'False': False}[text] if kind is bool else kind(text)
            options = replace(options, **{option.name: value})
        except (ValueError, KeyError, PsError):
            scan.note(f'recorded parameter {option.name} is not usable; '
                      f'{option.default!r} is used')
    return options


def reconstruct_stack(job: Job) -> str:
    """Do one job, on whatever machine.

    :returns: empty, or why this stack cannot be reconstructed.
    :raises OSError: if the disk fails.
    """
    try:
        data = Session(job.session).read(job.place)
        stack = message_to_stack(decode(data, STACK_TYPE))
        result = reconstruct(stack, job.options)
        about: dict[str, Any] = {**identity(stack), **figures(result)}
        with whole_folder(Path(job.folder)) as part:
            write_arrays(result, part)
            (part / 'stack.json').write_text(json.dumps(about, indent=2) + '\n')
    except OSError:
        raise
    except Exception as error:      # a foreign or hostile stack can be wrong in any way
        return reason(error)
    return ''


def figures(result: Reconstruction) -> dict[str, Any]:
    """Values of FIGURES; lengths in m."""
    return {'method': result.method, 'near_field': result.near_field, 'metric': result.metric,
            'valid_fraction': float(result.valid_fraction),
            'residual_rms': known(result.residual_rms),
            **{name: known(value) for name, value in asdict(result.roughness).items()},
            'seconds': round(sum(result.timings.values()), 4)}


def _results(jobs: list[Job], workers: Workers) -> Iterator[tuple[Job, str]]:
    """Every job with its failure, in the order in which they end."""
    if workers.scheduler:
        return _on_cluster(jobs, workers.scheduler)
    processes = min(workers.processes, len(jobs))
    if processes > 1:
        return _in_processes(jobs, processes)
    return ((job, reconstruct_stack(job)) for job in jobs)


def _in_processes(jobs: list[Job], processes: int) -> Iterator[tuple[Job, str]]:
    # spawned, because a fork would copy the locks of threads that it does not have
    pool = ProcessPoolExecutor(processes, get_context('spawn'))
    try:
        futures = {pool.submit(reconstruct_stack, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise PsError(ErrorCode.SESSION_INTERNAL,
                      'a worker process died, perhaps for want of memory; what is done stays: '
                      'run again, with fewer --workers') from error
    finally:
        pool.shutdown(cancel_futures=True)


def _on_cluster(jobs: list[Job], address: str) -> Iterator[tuple[Job, str]]:
    try:
        import distributed
    except ImportError as error:
        raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                      '--scheduler needs Dask: pip install distributed') from error
    try:
        client = distributed.Client(address, timeout=5, set_as_default=False)
    except (OSError, ValueError) as error:
        raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                      f'no Dask scheduler at {address}: {reason(error)}') from error
    with client:
        try:
            client.wait_for_workers(1, timeout=30)
        except TimeoutError as error:
            raise PsError(ErrorCode.SESSION_BAD_REQUEST,
                          f'the scheduler at {address} has no workers; start one with '
                          f'"dask worker {address} --nthreads 1"') from error
        # not pure: the files are the result, so nothing may be taken from an earlier run.
        # The scheduler gives the jobs of a lost worker to another one by itself.
        futures = client.map(reconstruct_stack, jobs, pure=False)
        of = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in distributed.as_completed(futures, loop=client.loop):
            failure = future.exception()
            if isinstance(failure, OSError):
                raise failure
            # else a job that killed every worker it was given to
            yield of[future.key], future.result() if failure is None else reason(failure)
