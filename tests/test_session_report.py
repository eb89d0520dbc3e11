"""The session report: what it says, and how it looks and works in a browser."""
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from browser import CHROMIUM, Browser
from sessions import record, rendered, shift

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.session_report import write_report
from ps_inspection.session_summary import summarize
from ps_reconstruction.session_reader import Session

PARTS = ('boss', 'scratches', 'weld')


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return Session(shift(tmp_path_factory.mktemp('session') / 'shift-1', scenes=PARTS))


@pytest.fixture(scope='module')
def page(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('report') / 'report.html'
    outcome = write_report(session, path)
    assert (outcome.stacks, outcome.pictures, outcome.failed) == (3, 3, {})
    assert outcome.faults == 3
    return path


class Links(HTMLParser):
    """Everything that a page could load."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or '' for name, value in attrs if name in ('src', 'href')]


def test_summary_tells_what_happened(session: Session) -> None:
    summary = summarize(session)
    assert [entry.facts['part_id'] for entry in summary.entries] == list(PARTS)
    assert summary.scan.problems == []
    for entry in summary.entries:
        assert entry.result is not None
        assert entry.acquired is not None
        assert entry.reconstructed is not None
        assert entry.acquired < entry.received < entry.reconstructed
        assert entry.result['durations']['normals'] > 0
    assert [(event.kind, event.source) for event in summary.events] == [
        ('fault', 'capture'), ('fault', 'head'), ('fault', 'ps_head/head_driver: Head'),
        ('ok', 'head'), ('ok', 'ps_head/head_driver: Head')]
    assert summary.events[0].text == 'SEQUENCER_FRAME_MISSING: 3 frames for 4 triggers'
    assert 'fault' in [state for _, state in summary.states]
    assert list(summary.calibrations) == ['cal-7']


def test_page_has_all_and_loads_nothing(page: Path) -> None:
    text = page.read_text(encoding='utf-8')
    for expected in (*PARTS, 'cal-7', 'PS-0042', 'ps_inspection 0.1.0', 'smoothness',
                     'panel BF_N draws no current', '100.0 250.0 300.0 in base',
                     'Trial &lt;1&gt; &amp;', '; 5.6 s. Trial'):
        assert expected in text, expected
    assert 'Trial <1>' not in text
    links = Links()
    links.feed(text)
    assert len([link for link in links.found if link.startswith('data:image/jpeg')]) == 6
    assert all(link.startswith('data:') for link in links.found)


def test_hostile_texts_stay_texts(tmp_path: Path) -> None:
    evil = '</script><script>document.title = "mine"</script><img src=x onerror=alert(1)>'
    stack = replace(rendered(scale=0.06), part_id=evil, stack_id=evil, calibration_id=evil)
    session = Session(record(tmp_path / 's', [stack], {'session': {'notes': evil},
                                                       'parameters/reconstruction': {evil: evil}}))
    outcome = write_report(session, tmp_path / 'report.html')
    assert outcome.pictures == 1
    text = (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert '<script>document' not in text
    assert 'src=x' not in text.replace('&lt;img src=x', '').replace('\\u003cimg src=x', '')


def test_bad_stacks_and_many_stacks(tmp_path: Path) -> None:
    good = rendered(scale=0.06)
    dark = replace(good, stack_id='one light', images=good.images[:1], lights=good.lights[:1])
    session = Session(record(tmp_path / 's', [good, b'\0\1\0\0rubbish', dark]))
    outcome = write_report(session, tmp_path / 'report.html')
    assert (outcome.stacks, outcome.pictures) == (2, 1)
    assert list(outcome.failed) == ['one light']
    assert len(outcome.problems) == 1
    many = Session(record(tmp_path / 'many', [replace(good, stack_id=f'{i}') for i in range(7)]))
    assert write_report(many, tmp_path / 'many.html', pictures=2).pictures == 2
    assert '2 of 7 stacks' in (tmp_path / 'many.html').read_text()
    empty = Session(record(tmp_path / 'empty', []))
    assert write_report(empty, tmp_path / 'empty.html').stacks == 0
    with pytest.raises(PsError) as caught:
        write_report(empty, tmp_path / 'many.html' / 'report.html')
    assert caught.value.code in (ErrorCode.SESSION_WRITE_FAILED, ErrorCode.SESSION_BAD_REQUEST)


# ---------------------------------------------------------------------------- in a browser

@pytest.fixture(scope='module')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip('needs chromium')
    with Browser(tmp_path_factory.mktemp('browser')) as browser:
        yield browser


# share of the canvas that the solid covers, and the sum of its pixels
CANVAS = """(() => {
    const canvas = document.getElementById('relief'), side = [canvas.width, canvas.height];
    const data = canvas.getContext('2d').getImageData(0, 0, ...side).data;
    let covered = 0, sum = 0;
    for (let i = 0; i < data.length; i += 4) {
        if (data[i + 3] === 255) covered++;
        sum = (sum * 31 + data[i] + 7 * data[i + 1]) % 1000003;
    }
    return [covered / (side[0] * side[1]), sum];
})()"""
# widths of all pictures, once they are decoded
PICTURES = """Promise.all([...document.querySelectorAll('img[src^="data:image"]')].map(
    async (image) => {
        image.loading = 'eager';
        await image.decode();
        return image.naturalWidth;
    }))"""


@pytest.mark.parametrize('width', [1280, 375])
def test_page_works_in_a_browser(browser: Browser, page: Path, width: int) -> None:
    browser.open(page, width)
    assert browser.script('document.documentElement.scrollWidth') <= width
    widths = browser.script(PICTURES)
    assert len(widths) == 6
    assert min(widths) > 100
    covered, picture = browser.script(CANVAS)
    assert covered > 0.1

    x, y = browser.script("""(() => {
        const canvas = document.getElementById('relief');
        canvas.scrollIntoView({block: 'center'});
        const box = canvas.getBoundingClientRect();
        return [box.x + box.width / 2, box.y + box.height / 2];
    })()""")
    browser.drag((x, y), (x + 60, y - 30))
    assert browser.script(CANVAS)[1] != picture
    # another part, chosen from its card
    before = browser.script(CANVAS)[1]
    browser.script("document.querySelectorAll('[data-relief]')[2].click()")
    browser.drawn()
    assert browser.script("document.getElementById('part').value") == '2'
    assert browser.script(CANVAS)[1] != before

    browser.script("""(() => {
        const tall = document.getElementById('tall');
        tall.value = 2;
        tall.dispatchEvent(new Event('input'));
    })()""")
    assert browser.script("document.getElementById('times').value") == '100'

    browser.script("document.querySelectorAll('button.picture')[1].click()")
    assert browser.script("document.getElementById('enlarged').open")
    assert browser.script("document.querySelector('#enlarged img').alt") == 'boss: normals'
    assert browser.script('document.documentElement.scrollWidth') <= width
    browser.script("document.querySelector('#enlarged img').click()")
    assert not browser.script("document.getElementById('enlarged').open")

    assert browser.errors == []
    assert browser.requests == []
