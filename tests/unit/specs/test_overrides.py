"""Values changed from outside with `a.b=c`."""

import pytest

from photonpano import SpecError
from photonpano.specs import load_spec, parse_spec

SPEC = "version: 1\nsource: {use: simulator}\nlevels: [{}, {scale: 0.5}, null]\nrun: {seed: 3}\n"


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("run.seed=1", ("run", "seed"), 1),
        ("run.seed = 1e3 ", ("run", "seed"), 1000),
        ("levels.1.scale=0.25", ("levels", 1, "scale"), 0.25),
        ("levels=1", ("levels",), [{"scale": "auto"}]),
        ("levels=until-converged", ("levels",), "until-converged"),
        ("levels.0={scale: 2}", ("levels", 0, "scale"), 2.0),
        ("render.reference=first", ("render", "reference"), "first"),
        ("graph.skips=[1, 2]", ("graph", "skips"), [1.0, 2.0]),
        ("resample.with.group_size=7", ("resample", "with", "group_size"), 7),
        ("locate.use=opencv-sift", ("locate", "use"), "opencv-sift"),
        ("locate.fallback=[]", ("locate", "fallback"), []),
        ("refine=[]", ("refine",), []),
        ("refine=drift", ("refine",), [{"use": "drift", "with": {"knots": 4}}]),
        ("run=", ("run", "seed"), 0),
        ("levels.2.scale=0.5", ("levels", 2, "scale"), 0.5),
        ("light=steady", ("light", "mode"), "steady"),
        ("light={mode: changing}", ("light", "mode"), "changing"),
        ("run.memory=1 GiB", ("run", "memory"), 2**30),
    ],
)
def test_override_sets_the_value(override, path, value, catalog):
    document = parse_spec(SPEC, overrides=[override], catalog=catalog).document
    for key in path:
        document = document[key]
    assert document == value


def test_later_overrides_win(catalog):
    plan = parse_spec(SPEC, overrides=["run={seed: 5}", "run.seed=6"], catalog=catalog)
    assert plan.run.seed == 6


def test_override_repairs_what_the_file_has_wrong(catalog):
    plan = parse_spec(SPEC.replace("seed: 3", "seed: -3"), overrides=["run.seed=3"], catalog=catalog)
    assert plan.run.seed == 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("run.seed", "expected KEY=VALUE, such as run.seed=1 (in the override run.seed)"),
        ("run..seed=1", "expected KEY=VALUE, such as run.seed=1 (in the override run..seed=1)"),
        ("=1", "expected KEY=VALUE, such as run.seed=1 (in the override =1)"),
        ("run.seed=-1", "run.seed: expected an integer of at least 0, got -1 (in the override run.seed=-1)"),
        ("run.sed=1", "run.sed: unknown key; did you mean 'seed'? (in the override run.sed=1)"),
        ("levels.3.scale=1", "levels.3.scale: levels is a list of 3, which has no '3' (in the override levels.3.scale=1)"),
        ("levels.-1={}", "levels.-1: levels is a list of 3, which has no '-1' (in the override levels.-1={})"),
        ("version.x=1", "version.x: version is 1, which has no 'x' (in the override version.x=1)"),
        ("run.seed=[1", "run.seed: not valid YAML: expected ',' or ']', but got '<stream end>' (in the override run.seed=[1)"),
        ("run.seed=!!f 1", "run.seed: tags such as !!f are not allowed (in the override run.seed=!!f 1)"),
        ("merge.use=zz", "merge.use: there is no merger 'zz'; known: photon-mle (in the override merge.use=zz)"),
    ],
)
def test_wrong_override_is_named(override, message, catalog):
    with pytest.raises(SpecError) as caught:
        parse_spec(SPEC, overrides=[override], catalog=catalog)
    assert [str(problem) for problem in caught.value.problems] == [message]


def test_problems_of_overrides_follow_those_of_the_file(catalog, tmp_path):
    path = tmp_path / "scan.yaml"
    path.write_text(SPEC + "render: {scale: 0}\n")
    with pytest.raises(SpecError) as caught:
        load_spec(path, overrides=["run.seed=x", "nothing"], catalog=catalog)
    found = [(problem.line, problem.where) for problem in caught.value.problems]
    assert found == [(5, "render.scale"), (None, ""), (None, "run.seed")]
