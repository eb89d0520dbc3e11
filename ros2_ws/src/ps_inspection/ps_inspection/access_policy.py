"""Access policy of the cell for SROS2: what every node may publish, read, serve and call.

The rights are read from a running graph, so they are exactly what the nodes use, and written in
the policy format of SROS2 (version 0.2.0), from which ``ros2 security generate_artifacts`` makes
keys and permissions. Names are relative to the node's namespace, or private, where they can be.
"""
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
import time
from typing import Any
from xml.etree import ElementTree as Xml

from ps_inspection.inspection_request import QUANTITIES

VERSION = '0.2.0'
# right: (element around the names, element of one name, attribute)
_KINDS = {
    'publish': ('topics', 'topic', 'publish'),
    'subscribe': ('topics', 'topic', 'subscribe'),
    'reply': ('services', 'service', 'reply'),
    'request': ('services', 'service', 'request'),
    'execute': ('actions', 'action', 'execute'),
    'call': ('actions', 'action', 'call'),
}
_ACTION = '/_action/'

Names = frozenset[str]


@dataclass(frozen=True)
class Rights:
    """Rights of one node; names as in the policy file: relative, private (~/x) or absolute."""

    enclave: str
    namespace: str
    node: str
    publish: Names = frozenset()
    subscribe: Names = frozenset()
    reply: Names = frozenset()
    request: Names = frozenset()
    execute: Names = frozenset()
    call: Names = frozenset()

    def absolute(self, kind: str) -> Names:
        """Names of one kind in full."""
        own = f'{self.namespace.rstrip("/")}/'
        return frozenset(
            name if name.startswith('/') else
            f'{own}{self.node}{name[1:]}' if name.startswith('~') else own + name
            for name in getattr(self, kind))


# Needed only at times, so that a look at the graph may miss them: (node, right, name).
ON_DEMAND = (
    ('ring_calibration', 'subscribe', 'stack'),                  # while it calibrates
    ('camera_sequencer', 'subscribe', 'camera/image_raw'),       # with camera:=topic
    ('camera_sequencer', 'subscribe', 'camera/camera_info'),
    ('inspection', 'subscribe', 'stack'),                        # while it searches
    *(('inspection', 'subscribe', f'{name}/image') for name in QUANTITIES),    # for files
)


def with_on_demand(rights: Rights) -> Rights:
    """Rights and those of ON_DEMAND."""
    for node, kind, name in ON_DEMAND:
        if node == rights.node:
            rights = replace(rights, **{kind: getattr(rights, kind) | {name}})
    return rights


def rights_of(observer: Any, node: str, namespace: str, enclave: str) -> Rights:
    """Rights that a running node uses now.

    :param observer: any rclpy node of the same graph.
    :raises NodeNameNonExistentError: if the node is not in the graph.
    """
    def names(query: Any) -> Names:
        return frozenset(_short(name, node, namespace) for name, _ in query(node, namespace))

    def plain(found: Names) -> Names:
        return frozenset(name for name in found if _ACTION not in name)

    def actions(found: Names) -> Names:
        return frozenset(name.partition(_ACTION)[0] for name in found if _ACTION in name)

    served = names(observer.get_service_names_and_types_by_node)
    asked = names(observer.get_client_names_and_types_by_node)
    return Rights(
        enclave, namespace, node,
        publish=plain(names(observer.get_publisher_names_and_types_by_node)),
        subscribe=plain(names(observer.get_subscriber_names_and_types_by_node)),
        reply=plain(served), request=plain(asked), execute=actions(served), call=actions(asked))


def running_rights(observer: Any, nodes: Collection[str], namespace: str = '/ps_head',
                   settle: float = 3.0, timeout: float = 60.0) -> list[Rights]:
    """Rights of running nodes, looked at until they have not changed for a while.

    :param settle: s without a change.
    :param timeout: s until all nodes must be there.
    :raises TimeoutError: naming the nodes that are not.
    """
    before: list[Rights] = []
    begin = since = time.monotonic()
    while time.monotonic() - since < settle or len(before) < len(nodes):
        if time.monotonic() - begin > timeout:
            raise TimeoutError(f'not in the graph: {set(nodes) - {r.node for r in before}}')
        now = [rights_of(observer, name, where, enclave) for name, where, enclave
               in sorted(observer.get_node_names_and_namespaces_with_enclaves())
               if where == namespace and name in nodes]
        if now != before:
            before, since = now, time.monotonic()
        time.sleep(0.1)
    return before


def _short(name: str, node: str, namespace: str) -> str:
    own = f'{namespace.rstrip("/")}/'
    if name.startswith(f'{own}{node}/'):
        return '~' + name[len(own) + len(node):]
    return name[len(own):] if own != '/' and name.startswith(own) else name


def to_xml(rights: Iterable[Rights], comment: str) -> str:
    """Policy file."""
    policy = Xml.Element('policy', version=VERSION)
    enclaves = Xml.SubElement(policy, 'enclaves')
    for each in sorted(rights, key=lambda r: r.enclave):
        enclave = Xml.SubElement(enclaves, 'enclave', path=each.enclave)
        profiles = Xml.SubElement(enclave, 'profiles')
        profile = Xml.SubElement(profiles, 'profile', ns=each.namespace, node=each.node)
        for kind, (group, single, attribute) in _KINDS.items():
            names = getattr(each, kind)
            if names:
                listed = Xml.SubElement(profile, group, {attribute: 'ALLOW'})
                for name in sorted(names):
                    Xml.SubElement(listed, single).text = name
    Xml.indent(policy)
    return (f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- {comment} -->\n'
            f'{Xml.tostring(policy, encoding="unicode")}\n')


def from_xml(text: str) -> list[Rights]:
    """Rights in a policy file.

    :raises ValueError: if it is not one that this software writes or a person may write likewise:
        every profile in an enclave of its own, and nothing but ALLOW of plain names.
    """
    policy = Xml.fromstring(text)
    if policy.tag != 'policy' or policy.get('version') != VERSION:
        raise ValueError(f'not a policy of version {VERSION}')
    result = []
    for enclave in policy.findall('enclaves/enclave'):
        (profile,) = enclave.findall('profiles/profile')
        found: dict[str, set[str]] = {}
        for listed in profile:
            for attribute, value in listed.attrib.items():
                if value != 'ALLOW' or _KINDS.get(attribute, ('',))[0] != listed.tag:
                    raise ValueError(f'{enclave.get("path")}: {listed.tag} {attribute}={value!r}')
                single = _KINDS[attribute][1]
                names = [(entry.text or '').strip() for entry in listed]
                if not names or any(entry.tag != single for entry in listed) or not all(names):
                    raise ValueError(f'{enclave.get("path")}: {listed.tag} needs {single} entries')
                if any('*' in name or '?' in name for name in names):
                    raise ValueError(f'{enclave.get("path")}: a pattern allows too much')
                found.setdefault(attribute, set()).update(names)
        result.append(Rights(
            enclave.get('path', ''), profile.get('ns', ''), profile.get('node', ''),
            **{kind: frozenset(names) for kind, names in found.items()}))
    return result
