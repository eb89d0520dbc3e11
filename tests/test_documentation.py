"""The documents keep their promises: whatever a user can touch is written down."""
import importlib
from pathlib import Path
import re
import subprocess
import sys

import pytest
import yaml

from ps_inspection.graph import NODES

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / 'ros2_ws' / 'src'
README = (ROOT / 'README.md').read_text()
DOCS = README + ''.join(page.read_text() for page in sorted((ROOT / 'docs').glob('*.md')))


def test_reference_page_is_what_the_code_says():
    subprocess.run([sys.executable, ROOT / 'scripts' / 'reference.py', '--check'], check=True,
                   timeout=120)


@pytest.mark.parametrize('path', sorted(
    path.relative_to(SOURCES) for kind in ('msg', 'srv', 'action')
    for path in (SOURCES / 'ps_interfaces' / kind).iterdir()), ids=str)
def test_interface_is_in_the_readme(path):
    assert re.search(rf'\b{path.stem}\b', README), f'{path} is not in README.md'


def declared_names() -> set[str]:
    """Names of topics, services and actions that the nodes create."""
    makers = r'create_(?:publisher|subscription|service|client)|ActionServer|subscribe'
    names = set()
    for module in SOURCES.glob('ps_*/ps_*/nodes/*.py'):
        names |= {f'{module.stem}/{name[2:]}' if name.startswith('~/') else name
                  for name in re.findall(
                      rf"(?:{makers})\(\s*(?:self,\s*)?[\w.]+,\s*'([~\w/]+)'", module.read_text())}
    return names


def test_names_are_found_in_the_code():
    assert {'stack', 'capture', 'session/start', 'ring_calibration/save'} <= declared_names()


@pytest.mark.parametrize('name', sorted(declared_names()))
def test_name_is_in_the_readme(name):
    assert name in README


@pytest.mark.parametrize('package', sorted(p.parent.name for p in SOURCES.glob('*/setup.py')))
def test_executables_are_documented(package):
    setup = (SOURCES / package / 'setup.py').read_text()
    for name in re.findall(r"'(\w+) = ", setup):
        assert f'`{name}' in DOCS, f'{name} of {package} is not in the documents'


def test_make_targets_are_documented():
    makefile = (ROOT / 'Makefile').read_text()
    for target in re.findall(r'^([a-z]+):', makefile, re.M):
        assert f'make {target}' in DOCS, f'make {target} is not in the documents'


@pytest.mark.parametrize('node', NODES, ids=lambda node: node.executable)
def test_configuration_file_states_every_parameter_with_its_default(node):
    module = importlib.import_module(f'{node.package}.nodes.{node.executable}')
    file = SOURCES / node.package / 'config' / f'{node.executable}.yaml'
    text = file.read_text()
    (parameters,) = (section['ros__parameters'] for section in _sections(yaml.safe_load(text)))
    assert list(parameters) == [p.name for p in module.PARAMETERS], 'keep the order of the code'
    for parameter in module.PARAMETERS:
        assert parameters[parameter.name] == pytest.approx(parameter.default), parameter.name
    for name in parameters:
        assert re.search(rf'#[^\n]*\n *{name}:|{name}:[^\n]*#', text), f'{name} has no comment'


def _sections(tree: dict) -> list[dict]:
    found = [tree] if 'ros__parameters' in tree else []
    return found + [s for value in tree.values() if isinstance(value, dict)
                    for s in _sections(value)]


def test_links_between_documents_lead_somewhere():
    for page in (ROOT / 'README.md', *(ROOT / 'docs').glob('*.md')):
        for link in re.findall(r'\]\((?!https?:|#|mailto:)([^)#\s]+)', page.read_text()):
            assert (page.parent / link).exists(), f'{page.name}: {link} is not there'
