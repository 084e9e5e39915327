"""Keys of findings.json, with their types, units and meanings: the table of docs/findings.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple


class FindingsKey(NamedTuple):
    """One key of findings.json.

    Attributes:
        path: from the top; ``[]`` stands for each entry of a list, ``*`` for a name, as that of a parameter.
        type: of JSON. What may be null says so, and keys below it are then not there.
    """

    path: str
    type: str
    unit: str
    text: str


KEYS = tuple(
    FindingsKey(*row)
    for row in (
        ("schema", "string", "", "`ctr_dynamics/findings/1`; another number says that a key means something else"),
        ("verdict", "string", "", "one of the verdicts of docs/diagnosis.md"),
        ("causes", "list", "", "causes of the verdict; empty where it is `clean` or `not_excited`"),
        ("causes[].effect", "string", "", "name in the catalogue of effects, `config_mistake`, or `unknown`: outside the catalogue"),
        ("causes[].parameters", "object", "", "of the effect by their names, shapes among them; empty for `unknown`"),
        ("causes[].parameters.*.value", "number or null", "`unit`", "fitted; null for no limit, and a name for `config_mistake`"),
        ("causes[].parameters.*.ci90", "list of 2 or null", "`unit`", "90 % interval; an end that has no limit is null"),
        ("causes[].parameters.*.ci99", "list of 2 or null", "`unit`", "99 % interval"),
        ("causes[].parameters.*.unit", "string", "", "SI; `1` for numbers without a unit, `name` for a mistake"),
        ("causes[].parameters.*.nominal", "number or null", "`unit`", "at which the robot is as its file says; null for no limit"),
        ("causes[].probability", "number or null", "", "of the effect, over all hypotheses with it; null where none can be given"),
        ("causes[].separation", "number or null", "whitened", "from the nearest rival; null without a candidate"),
        ("causes[].not_separable_from", "list of strings", "", "effects that could stand in its place, nearest first"),
        ("causes[].text", "string", "", "the cause as a sentence"),
        ("cause_set95", "list of lists", "", "sets of effects that hold the probability 0.95 together, likeliest first; `[[]]` for `clean`"),
        ("tested", "list of strings", "", "effects and errors that were looked for"),
        ("not_observable", "list of strings", "", "effects that these bags cannot show"),
        ("numerics.time_error_m", "number or null", "m", "rms of what the last refinement of the step changed; null where it was not measured"),
        ("numerics.space_error_m", "number or null", "m", "the same of twice the nodes"),
        ("numerics.within_noise", "boolean or null", "", "whether both are below a fifth of the noise"),
        ("residual.nominal_rms_m", "number or null", "m", "3-D rms of the fitted bags against the robot file"),
        ("residual.recalibrated_rms_m", "number or null", "m", "the same against `recalibrated_robot`"),
        ("residual.extended_rms_m", "number or null", "m", "the same against `extended_robot`"),
        ("residual.noise_floor_m", "number", "m", "rms of the noise of the tracker, as the robot file states it"),
        ("residual.whiteness_p", "number or null", "", "probability of the residual tests for what the extension leaves"),
        ("discrepancy", "object or null", "", "what remains and is more than noise"),
        ("discrepancy.rms_m", "number", "m", "3-D, expected given the data"),
        ("discrepancy.correlation_time_s", "number", "s", "at which its correlation has fallen to 1/e"),
        ("discrepancy.share_of_misfit", "number or null", "", "part of the squared residual beyond noise of `recalibrated_robot`"),
        ("validation", "object or null", "", "on the bags that were not fitted; null without any"),
        ("validation.rms_nominal_m", "number or null", "m", "of the robot file"),
        ("validation.rms_recalibrated_m", "number", "m", "of `recalibrated_robot`"),
        ("validation.rms_extended_m", "number", "m", "of `extended_robot`"),
        ("validation.gain", "number", "", "part of the squared error of `recalibrated_robot` that the extension removes"),
        ("validation.ci95", "list of 2", "", "95 % interval of `gain`"),
        ("validation.gain_over_nominal", "number or null", "", "part of the squared error of the robot file that both remove"),
        ("validation.nis_before", "number or null", "", "whitened squares for each value of `recalibrated_robot`: 1 is noise"),
        ("validation.nis_after", "number or null", "", "the same of `extended_robot`"),
        ("learned", "object or null", "", "a learned force that predicts bags that were not fitted"),
        ("learned.kind", "string", "", "`force on the tip`"),
        ("learned.terms", "list", "", "terms of the force"),
        ("learned.terms[].parameter", "string", "", "of the extension"),
        ("learned.terms[].value", "number", "`unit`", "coefficient"),
        ("learned.terms[].ci90", "list of 2", "`unit`", "90 % interval; an end that has no limit is null"),
        ("learned.terms[].unit", "string", "", "SI"),
        ("learned.terms[].text", "string", "", "what the term is"),
        ("learned.extension", "string", "", "name of the extension in `extended_robot`"),
        ("learned.gain", "number", "", "part of the squared error that the force removes on `held_out`"),
        ("learned.ci95", "list of 2", "", "95 % interval of `gain`"),
        ("learned.held_out", "string", "", "data on which the gain was measured"),
        ("next_experiment", "object or null", "", "an experiment that tells apart what is left; null where nothing is"),
        ("next_experiment.description", "string", "", "motions and loads in words"),
        ("next_experiment.scenario_file", "string", "", "beside findings.json; for `simulate` or a robot's driver"),
        ("next_experiment.separation_before", "number or null", "whitened", "smallest one by the bags at hand"),
        ("next_experiment.separation_after", "number or null", "whitened", "the same with the experiment"),
        ("tolerances", "list", "", "tolerances that are too tight; empty but for the verdict `tolerances`"),
        ("tolerances[].parameter", "string", "", "effect and parameter, with a dot between them"),
        ("tolerances[].unit", "string", "", "SI"),
        ("tolerances[].stated", "number", "`unit`", "standard deviation in the robot file"),
        ("tolerances[].suggested", "number", "`unit`", "what the data suggest"),
        ("tolerances[].evidence", "number", "", "natural logarithm of the Bayes factor for a wider one"),
        ("extended_robot", "string or null", "", "file beside findings.json"),
        ("recalibrated_robot", "string or null", "", "file beside findings.json"),
        ("reproduce", "string", "", "command that gives these findings again"),
        ("seconds", "number", "s", "time that the diagnosis took"),
        ("probabilities", "list", "", "sets of effects, likeliest first"),
        ("probabilities[].effects", "list of strings", "", "empty for no cause; `unknown` for something outside the catalogue"),
        ("probabilities[].probability", "number or null", "", "of the set"),
        ("notes", "list of strings", "", "what a reader should know, as sentences"),
        ("version", "string", "", "of this package"),
        ("robot.name", "string", "", "from the robot file"),
        ("robot.source", "string", "", "file or shipped robot"),
        ("robot.sha256", "string", "", "of the file"),
        ("inputs", "list", "", "files of the fitted bags"),
        ("inputs[].name", "string", "", "of the file"),
        ("inputs[].sha256", "string", "", "of the file"),
        ("parameters", "object", "", "resolution of the simulations; empty where a configuration mistake ended the diagnosis"),
        ("parameters.nodes", "integer", "", "nodes along the tubes"),
        ("parameters.dt_s", "number", "s", "shortest step"),
        ("parameters.longest_dt_s", "number", "s", "longest step"),
    )
)  # fmt: skip


def undocumented(content: dict[str, Any]) -> set[str]:
    """Paths of values in ``content``, that of a findings.json, that are not in the table."""
    known = {key.path for key in KEYS}
    return set(_paths(content, "", known)) - known


def _paths(value: Any, at: str, known: set[str]) -> Iterator[str]:
    """Paths of all values in ``value``, which is at the path ``at``."""
    if isinstance(value, dict):
        named = not any(path.startswith(f"{at}.*") for path in known)
        for key, below in value.items():
            yield from _paths(below, f"{at}.{key if named else '*'}".lstrip("."), known)
    elif isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        for entry in value:
            yield from _paths(entry, f"{at}[]", known)
    else:
        yield at
