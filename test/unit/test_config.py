"""Parameters: names, ranges, refusals."""

import pytest

from bdgs_ros.core.config import BdgsConfig, specs, validate, with_values
from bdgs_ros.core.errors import ConfigError


def test_defaults_are_in_their_own_ranges() -> None:
    validate(BdgsConfig())


def test_every_parameter_says_what_it_means() -> None:
    assert all(spec.doc for spec in specs(BdgsConfig()))


def test_text_is_converted_to_the_type_of_the_default() -> None:
    config = with_values(
        BdgsConfig(),
        {
            'tracking.align.max_iterations': '12',
            'belief.enabled': 'false',
            'belief.decay_rate': '1',
        },
    )
    assert config.tracking.align.max_iterations == 12
    assert config.belief.enabled is False
    assert config.belief.decay_rate == 1.0


def test_misspelt_name_suggests_the_right_one() -> None:
    with pytest.raises(ConfigError, match=r"did you mean 'mapping.iterations'"):
        with_values(BdgsConfig(), {'mapping.iteration': 3})


@pytest.mark.parametrize(
    ('name', 'value', 'allowed'),
    [
        ('belief.margin', 0.7, '0 to 0.49'),
        ('mapping.backend', 'opengl', "one of 'auto'"),
        ('mapping.iterations', 'many', '0 to 1000'),
        ('mapping.iterations', 2.5, '0 to 1000'),
        ('belief.enabled', 'perhaps', 'true or false'),
        ('belief.margin', float('nan'), '0 to 0.49'),
    ],
)
def test_refusals_name_the_allowed_range(name: str, value: object, allowed: str) -> None:
    with pytest.raises(ConfigError, match=allowed) as error:
        with_values(BdgsConfig(), {name: value})
    assert name in str(error.value)
