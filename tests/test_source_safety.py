"""No code path runs data as code: no pickle, no eval, no shell, only the safe YAML loader."""
import ast
import importlib
from pathlib import Path
import re
import subprocess

import pytest

from ps_inspection.graph import NODES

ROOT = Path(__file__).resolve().parents[1]
# modules that build objects or code from data
FORBIDDEN_MODULES = {'pickle', 'cPickle', '_pickle', 'dill', 'cloudpickle', 'joblib', 'marshal',
                     'shelve', 'jsonpickle'}
FORBIDDEN_CALLS = {'eval', 'exec', 'compile', '__import__'}
# dotted ends of calls, and the keyword arguments that alone make them safe
FORBIDDEN_METHODS = {'os.system', 'os.popen', 'yaml.load', 'yaml.unsafe_load', 'yaml.full_load',
                     'yaml.load_all', 'tempfile.mktemp'}


def sources() -> list[Path]:
    listed = subprocess.run(['git', 'ls-files', '-co', '--exclude-standard', '*.py'], cwd=ROOT,
                            capture_output=True, text=True, check=False).stdout.split()
    return [ROOT / name for name in listed] or [
        path for folder in ('ros2_ws/src', 'scripts', 'tests', 'examples')
        for path in (ROOT / folder).rglob('*.py')]


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f'{dotted(node.value)}.{node.attr}'
    return node.id if isinstance(node, ast.Name) else ''


def offences(tree: ast.AST) -> list[str]:
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            if isinstance(node, ast.ImportFrom):
                names = [node.module or '']
            found += [f'line {node.lineno}: import {name}' for name in names
                      if name.split('.')[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.Call):
            name = dotted(node.func)
            keywords = {word.arg: word.value for word in node.keywords}
            true = [word for word in ('shell', 'allow_pickle')
                    if isinstance(keywords.get(word), ast.Constant) and keywords[word].value]
            if name in FORBIDDEN_CALLS | FORBIDDEN_METHODS or true:
                found.append(f'line {node.lineno}: {name}({", ".join(true)})')
    return found


@pytest.mark.parametrize('code', [
    'import pickle', 'from cloudpickle import loads', 'import joblib.parallel', 'eval(x)',
    'exec(x)', 'os.system(x)', 'subprocess.run(x, shell=True)', 'np.load(x, allow_pickle=True)',
    'yaml.load(x, Loader=yaml.Loader)', 'yaml.unsafe_load(x)'])
def test_the_check_sees(code):
    assert offences(ast.parse(code))


@pytest.mark.parametrize('code', [
    'yaml.safe_load(x)', 'np.load(x)', 'np.load(x, allow_pickle=False)', 're.compile(x)',
    'subprocess.run(x)', 'import pickletools_of_mine', 'self.eval(x)'])
def test_the_check_lets_pass(code):
    assert not offences(ast.parse(code))


def test_no_data_are_run_as_code():
    files = sources()
    assert len(files) > 50
    found = [f'{path.relative_to(ROOT)}: {offence}' for path in files if path.is_file()
             for offence in offences(ast.parse(path.read_text()))]
    assert not found, '\n'.join(found)


@pytest.mark.parametrize('node', NODES, ids=lambda node: node.executable)
def test_parameters_that_name_files_are_read_once(node):
    """Else whoever may set parameters could make the node read or write elsewhere."""
    module = importlib.import_module(f'{node.package}.nodes.{node.executable}')
    changeable = [p.name for p in module.PARAMETERS if not p.read_only and
                  re.search(r'(file|folder|port|socket|directory|path)$', p.name)]
    assert not changeable
