"""Parameters: declared with their ranges, checked at the start and afterwards."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

rclpy = pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = pytest.mark.ros

from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from bdgs_ros.bridge import parameters  # noqa: E402
from bdgs_ros.bridge.node_config import (  # noqa: E402
    NODE_CONFIGS,
    ReplayConfig,
    TrackingNodeConfig,
    known_names,
)
from bdgs_ros.core.config import specs, validate  # noqa: E402
from bdgs_ros.core.errors import ConfigError  # noqa: E402


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context, domain_id=201)
    yield context
    rclpy.shutdown(context=context)


def make(context: Context, **values: object) -> Node:
    overrides = [Parameter(name.replace('__', '.'), value=v) for name, v in values.items()]
    return Node('probe', context=context, parameter_overrides=overrides)


@pytest.mark.parametrize('name', sorted(NODE_CONFIGS))
def test_every_default_is_allowed(name: str) -> None:
    validate(NODE_CONFIGS[name]())


def test_one_name_has_one_meaning_in_all_nodes() -> None:
    """Nodes share a yaml file, so a name must not have two types."""
    kinds: dict[str, type] = {}
    for config in NODE_CONFIGS.values():
        for spec in specs(config()):
            assert kinds.setdefault(spec.name, type(spec.value)) is type(spec.value), spec.name


def test_overrides_reach_the_dataclass(context: Context) -> None:
    node = make(context, tracking__motion__gate_sigma=4, mode='lockstep', rate=2.0)
    config = parameters.declare(node, TrackingNodeConfig())
    assert config.tracking.motion.gate_sigma == 4.0  # given as an integer
    assert config.lockstep
    assert node.get_parameter('tracking.motion.gate_sigma').value == 4.0
    assert not node.has_parameter('rate')  # of another node: accepted, not used


def test_description_and_range_are_declared(context: Context) -> None:
    node = make(context)
    parameters.declare(node, TrackingNodeConfig())
    found = node.describe_parameter('tracking.motion.gate_sigma')
    assert 'sigma' in found.description
    assert found.floating_point_range[0].from_value == 1.0
    found = node.describe_parameter('mode')
    assert "'lockstep'" in found.additional_constraints


def test_a_misspelt_name_is_refused_with_a_suggestion(context: Context) -> None:
    node = make(context, tracking__motion__gate_sigm=4.0, rete=1.0)
    with pytest.raises(ConfigError) as refusal:
        parameters.declare(node, ReplayConfig())
    assert "'tracking.motion.gate_sigm'; did you mean 'tracking.motion.gate_sigma'" in str(
        refusal.value
    )
    assert "'rete'; did you mean 'rate'" in str(refusal.value)


def test_a_value_out_of_range_is_refused_with_the_range(context: Context) -> None:
    node = make(context, rate=1000.0)
    with pytest.raises(ConfigError, match=r"'rate' = 1000.0 is refused.*0.01 to 100"):
        parameters.declare(node, ReplayConfig())


def test_ros_own_parameters_pass(context: Context) -> None:
    node = make(context, use_sim_time=True)
    parameters.declare(node, ReplayConfig())


def test_changes_at_run_time(context: Context) -> None:
    node = make(context)
    parameters.declare(node, TrackingNodeConfig(), runtime=('trajectory_file',))
    refused = node.set_parameters([Parameter('tracking.masked', value=False)])[0]
    assert not refused.successful
    assert 'restart the node' in refused.reason
    accepted = node.set_parameters([Parameter('trajectory_file', value='/tmp/t.txt')])[0]
    assert accepted.successful
    assert node.get_parameter('trajectory_file').value == '/tmp/t.txt'


def test_known_names_are_dotted_paths_of_the_configs() -> None:
    names = known_names()
    assert {'bag', 'mode', 'qos.reliability', 'mapping.iterations', 'belief.margin'} <= set(names)
