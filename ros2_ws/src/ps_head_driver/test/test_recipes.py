"""Recipes: the file, and the strobe programs they become."""
from pathlib import Path

import pytest
import yaml

from ps_head_driver.errors import ErrorCode, PsError
from ps_head_driver.recipes import Recipe, load_recipes
from ps_head_driver.sequence import plan
from ps_head_driver.stack import Mode, Panel

SHIPPED = Path(__file__).resolve().parents[1] / 'config' / 'recipes.yaml'


def test_shipped_recipes_are_the_four_views():
    recipe = load_recipes(SHIPPED).get('')
    (segment,) = plan(recipe, 0.004)
    assert [shot.panel for shot in segment.shots] == [Panel.E, Panel.N, Panel.W, Panel.S]
    assert {shot.mode for shot in segment.shots} == {Mode.BRIGHT_FIELD}
    assert {shot.exposure for shot in segment.shots} == {0.004}


def test_steps_at_one_cr_form_one_program_and_ambient_comes_last():
    recipe = Recipe.model_validate({'ambient': True, 'exposure': 0.01, 'steps': [
        {'panel': 'E', 'convergence_radius': 0.06}, {'panel': 'W', 'convergence_radius': 0.06},
        {'panel': 'E', 'convergence_radius': 0.02}]})
    first, second = plan(recipe, 0.004)
    assert (first.convergence_radius, len(first.shots)) == (0.06, 2)
    assert (second.convergence_radius, len(second.shots)) == (0.02, 2)
    assert second.shots[-1].panel is Panel.NONE
    assert second.shots[-1].exposure == 0.01


def test_a_bracket_takes_every_light_with_every_exposure_one_program_for_each():
    recipe = Recipe.model_validate({
        'ambient': True, 'bracket': [4, 1], 'exposure': 0.001,
        'steps': [{'panel': panel, 'convergence_radius': 0.06} for panel in 'EW']})
    short, long = plan(recipe, 1.0, 3.0)
    assert [shot.panel for shot in short.shots] == [Panel.E, Panel.W, Panel.NONE]
    assert [shot.light for shot in short.shots] == [shot.light for shot in long.shots] == [0, 1, 2]
    assert {shot.exposure for shot in short.shots} == {0.001}
    assert {shot.exposure for shot in long.shots} == {0.004}
    assert {shot.gain for shot in short.shots} == {3.0}
    assert (short.convergence_radius, long.convergence_radius) == (0.06, 0.0)   # moved once


def test_a_program_has_one_exposure_and_one_gain():
    recipe = Recipe.model_validate({'steps': [
        {'panel': 'E'}, {'panel': 'N'}, {'panel': 'W', 'exposure': 0.02},
        {'panel': 'S', 'exposure': 0.02, 'gain': 6.0}]})
    assert [[shot.panel.name for shot in program.shots] for program in plan(recipe, 0.004)] == [
        ['E', 'N'], ['W'], ['S']]


@pytest.mark.parametrize(('change', 'named'), [
    ({'default': 'nothing'}, 'nothing'),
    ({'recipes': {'a': {'steps': []}}}, 'recipes.a.steps'),
    ({'recipes': {'a': {'steps': [{'panel': 'NE'}]}}}, 'panel'),
    ({'recipes': {'a': {'steps': [{'panel': 'E', 'exposure': -1}]}}}, 'exposure'),
    ({'recipes': {'a': {'steps': [{'panel': 'E', 'colour': 1}]}}}, 'colour'),
    ({'recipes': {'a': {'ambient': True, 'steps': [
        {'panel': 'E', 'exposure': 0.1}, {'panel': 'W', 'exposure': 0.2}]}}}, 'same exposure'),
    ({'recipes': {'a': {'ambient': True, 'steps': [
        {'panel': 'E', 'gain': 6}, {'panel': 'W'}]}}}, 'same exposure and gain'),
    ({'recipes': {'a': {'steps': [{'panel': 'E'}], 'bracket': [1, 0]}}}, 'bracket'),
    ({'recipes': {'a': {'steps': [{'panel': 'E'}], 'bracket': [1, 4, 1]}}}, 'factor twice'),
    ({'recipes': {'a': {'steps': [{'panel': 'E'}] * 32, 'bracket': [1, 2, 4, 8]}}}, '128 frames'),
])
def test_wrong_recipe_file_is_refused_with_the_field(tmp_path, change, named):
    content = {'default': 'a', 'recipes': {'a': {'steps': [{'panel': 'E'}]}}} | change
    path = tmp_path / 'recipes.yaml'
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(PsError, match=named) as error:
        load_recipes(path)
    assert error.value.code == ErrorCode.SEQUENCER_BAD_REQUEST
    assert 'recipes.yaml' in error.value.message


def test_unknown_recipe_says_which_there_are():
    with pytest.raises(PsError, match='bright_field, ') as error:
        load_recipes(SHIPPED).get('matt')
    assert error.value.code == ErrorCode.SEQUENCER_UNKNOWN_RECIPE
