"""Policy files of SROS2 and what belongs to them: form, no patterns, ports of the domain."""
from pathlib import Path
import re
from types import SimpleNamespace

import pytest

from ps_inspection.access_policy import Rights, from_xml, rights_of, to_xml
from ps_inspection.graph import NODES

SECURITY = Path(__file__).resolve().parents[1] / 'config' / 'security'
RIGHTS = Rights(
    '/ps_head/a', '/ps_head', 'a', publish=frozenset({'stack', '/rosout'}),
    reply=frozenset({'~/home'}), execute=frozenset({'inspect'}), request=frozenset({'capture'}))


def test_round_trip():
    assert from_xml(to_xml([RIGHTS], 'x')) == [RIGHTS]


def test_names_in_full():
    assert RIGHTS.absolute('publish') == {'/ps_head/stack', '/rosout'}
    assert RIGHTS.absolute('reply') == {'/ps_head/a/home'}


def test_actions_are_gathered_from_their_services():
    def listed(*names: str):
        return lambda node, namespace: [(name, ['type']) for name in names]
    observer = SimpleNamespace(
        get_publisher_names_and_types_by_node=listed(
            '/rosout', '/left/act/_action/feedback', '/left/act/_action/status', '/left/node/x'),
        get_subscriber_names_and_types_by_node=listed('/left/stack', '/leftover/stack'),
        get_service_names_and_types_by_node=listed(
            '/left/node/home', '/left/act/_action/send_goal', '/left/act/_action/get_result'),
        get_client_names_and_types_by_node=listed('/left/other/_action/send_goal'))
    assert rights_of(observer, 'node', '/left', '/left/node') == Rights(
        '/left/node', '/left', 'node', publish=frozenset({'/rosout', '~/x'}),
        subscribe=frozenset({'stack', '/leftover/stack'}), reply=frozenset({'~/home'}),
        execute=frozenset({'act'}), call=frozenset({'other'}))


@pytest.mark.parametrize(('old', 'new'), [
    ('version="0.2.0"', 'version="0.1.0"'), ('publish="ALLOW"', 'publish="DENY"'),
    ('publish="ALLOW"', 'request="ALLOW"'), ('<topic>stack</topic>', '<topic>*</topic>'),
    ('<topic>stack</topic>', '<topic> </topic>'),
    ('<topic>stack</topic>', '<service>a</service>')])
def test_other_policies_are_refused(old, new):
    text = to_xml([RIGHTS], 'x')
    assert old in text
    with pytest.raises(ValueError):      # noqa: PT011
        from_xml(text.replace(old, new))


@pytest.mark.parametrize('name', ['cell.policy.xml', 'clients.policy.xml'])
def test_every_enclave_is_that_of_its_node(name):
    for rights in from_xml((SECURITY / name).read_text()):
        assert rights.enclave == f'{rights.namespace}/{rights.node}'


def test_every_node_of_the_cell_has_its_rights():
    allowed = from_xml((SECURITY / 'cell.policy.xml').read_text())
    assert {rights.node for rights in allowed} == {node.executable for node in NODES}, (
        'run scripts/security_policy.py')


def test_firewall_ports_are_those_of_the_domain():
    domain = int(re.search(r'^ROS_DOMAIN_ID=(\d+)$', (SECURITY / 'cell.env').read_text(), re.M)[1])
    low, high = re.search(r'domain_ports = (\d+)-(\d+)', (SECURITY / 'ps_head.nft').read_text()
                          ).groups()
    assert (int(low), int(high)) == (7400 + 250 * domain, 7400 + 250 * domain + 249)
