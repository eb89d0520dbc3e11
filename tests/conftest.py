"""What tests of the running graph share: an own ROS domain, and real data."""
from collections.abc import Iterator
import fcntl
import itertools
import os
from pathlib import Path
import tempfile

import pytest

DATA = Path(os.environ.get('PS_DATA', Path(__file__).resolve().parents[2] / 'shared' / 'data'))


DOMAINS = range(20, 100)
_used = itertools.count()


@pytest.fixture(scope='module')
def ros_domain() -> Iterator[int]:
    """A ROS domain that no other test of this user has, also not one of a parallel run.

    Not the one before either: what its processes leave behind would be heard.
    """
    saved = {name: os.environ.get(name) for name in (
        'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE')}
    begin = next(_used)
    for domain in (*DOMAINS[begin % len(DOMAINS):], *DOMAINS[:begin % len(DOMAINS)]):
        path = Path(tempfile.gettempdir()) / f'ps_test_domain_{os.getuid()}_{domain}.lock'
        with open(path, 'w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            os.environ['ROS_DOMAIN_ID'] = str(domain)
            os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
            try:
                yield domain
            finally:
                for name, value in saved.items():
                    if value is None:
                        os.environ.pop(name, None)
                    else:
                        os.environ[name] = value
            return
    pytest.fail('no free ROS domain between 20 and 99')


@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Real pictures with ground truth; tests that need them are skipped without them."""
    if not DATA.is_dir():
        pytest.skip(f'no test data at {DATA}; set PS_DATA')
    return DATA
