"""A headless Chromium for tests of HTML pages, driven over a pipe: no driver, no network port."""
import base64
import json
import os
from pathlib import Path
import select
import shutil
import subprocess
import time
from types import TracebackType
from typing import Any

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
    'google-chrome')


class Browser:
    """One page of a headless browser; a context manager.

    :param profile: folder for its files.

    ``errors`` collects console errors and exceptions of scripts, ``requests`` every URL that a
    page asks for besides itself and data: URLs.
    """

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._number = 0
        self._buffer = b''
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()

        def descriptors() -> None:
            # the browser reads 3 and writes 4; first out of the way of both
            low, high = os.dup2(to_browser, 13), os.dup2(from_browser, 14)
            os.dup2(low, 3)
            os.dup2(high, 4)

        self._process = subprocess.Popen(
            [CHROMIUM, '--headless', '--no-sandbox', '--disable-gpu', '--hide-scrollbars',
             '--no-first-run', '--disable-dev-shm-usage', '--disable-background-networking',
             '--remote-debugging-pipe', f'--user-data-dir={profile}', 'about:blank'],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            preexec_fn=descriptors, close_fds=False, start_new_session=True)
        os.close(to_browser)
        os.close(from_browser)
        self._session = ''
        target = next(t for t in self.command('Target.getTargets')['targetInfos']
                      if t['type'] == 'page')
        self._session = self.command('Target.attachToTarget', targetId=target['targetId'],
                                     flatten=True)['sessionId']
        for domain in ('Page', 'Runtime', 'Network', 'Log'):
            self.command(f'{domain}.enable')

    def __enter__(self) -> 'Browser':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        os.killpg(self._process.pid, 9)
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def command(self, method: str, **parameters: Any) -> Any:
        """Send a command of the DevTools protocol and wait for its answer."""
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        data = json.dumps(message).encode() + b'\0'
        while data:
            data = data[os.write(self._out, data):]
        while True:
            answer = self._receive()
            if answer.get('id') == self._number:
                assert 'error' not in answer, f'{method}: {answer["error"]}'
                return answer['result']

    def _receive(self, seconds: float = 60.0) -> dict[str, Any]:
        end = time.monotonic() + seconds
        while b'\0' not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            assert ready, 'the browser does not answer'
            self._buffer += os.read(self._in, 1 << 20)
        line, _, self._buffer = self._buffer.partition(b'\0')
        message: dict[str, Any] = json.loads(line)
        self._note(message.get('method', ''), message.get('params', {}))
        return message

    def _note(self, method: str, event: dict[str, Any]) -> None:
        if method == 'Runtime.exceptionThrown':
            self.errors.append(json.dumps(event['exceptionDetails'])[:500])
        elif method == 'Runtime.consoleAPICalled' and event['type'] in ('error', 'warning'):
            self.errors.append(json.dumps(event['args'])[:500])
        elif method == 'Log.entryAdded' and event['entry']['level'] == 'error':
            self.errors.append(event['entry']['text'])
        elif method == 'Network.requestWillBeSent':
            url = event['request']['url']
            if not url.startswith('data:') and url != event.get('documentURL'):
                self.requests.append(url)

    def open(self, page: Path, width: int, height: int = 900) -> None:
        """Show a file in a window of this size; returns when it is loaded and drawn."""
        self.command('Emulation.setDeviceMetricsOverride', width=width, height=height,
                     deviceScaleFactor=1, mobile=width < 600)
        self.command('Page.navigate', url=page.resolve().as_uri())
        end = time.monotonic() + 60
        while self.script('document.readyState') != 'complete':
            assert time.monotonic() < end, 'the page does not load'
            time.sleep(0.05)
        self.drawn()

    def drawn(self) -> None:
        """Wait for two animation frames."""
        self.script('new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))')

    def script(self, expression: str) -> Any:
        """Value of a JavaScript expression in the page; a promise is awaited."""
        answer = self.command('Runtime.evaluate', expression=expression, returnByValue=True,
                              awaitPromise=True)
        assert 'exceptionDetails' not in answer, answer['exceptionDetails']
        return answer['result'].get('value')

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag with the left mouse button."""
        def mouse(kind: str, place: tuple[float, float]) -> None:
            self.command('Input.dispatchMouseEvent', type=kind, x=place[0], y=place[1],
                         button='left', buttons=1, clickCount=1)
        mouse('mousePressed', begin)
        mouse('mouseMoved', end)
        mouse('mouseReleased', end)
        self.drawn()

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """Picture of the page, or of the window only."""
        data = self.command('Page.captureScreenshot', format='png', captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(data['data']))
