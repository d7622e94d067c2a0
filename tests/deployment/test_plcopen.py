"""PLCopen XML of a controller: the same block as its structured text."""

from xml.etree.ElementTree import fromstring

import numpy as np
import pytest
from oracles.structured_text import run as run_text
from test_deploy_code import of_one_channel, random_controller

from ccd_casadi.deployment.realisation import with_anti_windup
from ccd_casadi.deployment.source_code import vectors
from ccd_casadi.extensions.formats.code_formats import SPACE, XHTML, plcopen_xml, structured_text

N = {"p": SPACE, "h": XHTML}
WORDS = {"inputVars": "VAR_INPUT", "outputVars": "VAR_OUTPUT", "localVars": "VAR"}


def text_of(xml: str) -> str:
    """The structured text that a PLC's program makes of the file."""
    pou = fromstring(xml).find("p:types/p:pous/p:pou", N)
    assert pou is not None
    assert pou.get("pouType") == "functionBlock"
    lines = [f"FUNCTION_BLOCK {pou.get('name')}"]
    for held in pou.find("p:interface", N) or ():
        kind = WORDS[held.tag.partition("}")[2]]
        lines.append(kind + (" CONSTANT" if held.get("constant") == "true" else ""))
        for variable in held:
            place, array = variable.find("p:type", N), variable.find("p:type/p:array", N)
            assert place is not None
            kind = ""
            if array is not None:
                size, place = array.find("p:dimension", N), array.find("p:baseType", N)
                assert size is not None
                kind = f"ARRAY[{size.get('lower')}..{size.get('upper')}] OF "
            kind += place[0].tag.partition("}")[2]  # type: ignore[index]
            one = variable.find("p:initialValue/p:simpleValue", N)
            many = variable.findall("p:initialValue/p:arrayValue/p:value/p:simpleValue", N)
            start = "" if one is None else f" := {one.get('value')}"
            start = f" := [{', '.join(str(v.get('value')) for v in many)}]" if many else start
            lines.append(f"    {variable.get('name')} : {kind}{start};")
        lines.append("END_VAR")
    body = pou.find("p:body/p:ST/h:p", N)
    assert body is not None
    return "\n".join([*lines, str(body.text), "END_FUNCTION_BLOCK"]) + "\n"


@pytest.mark.parametrize(("pairs", "inputs", "limit"), [(0, 1, None), (2, 1, 5e-3), (3, 3, 5e-3)])
def test_the_xml_holds_the_same_block(pairs: int, inputs: int, limit: float | None) -> None:
    found = with_anti_windup(of_one_channel(random_controller(5, pairs, 1, inputs), limit), 500.0)
    errors, forwards, first, forces = vectors(found)
    text = structured_text(found, title="a < b & c", delay=1e-4, verified=True)
    xml = plcopen_xml(text, "a < b & c")
    calls = [
        {"E": list(e), "F": list(f), "U_BEFORE": list(first), "TAKEOVER": k == 0}
        for k, (e, f) in enumerate(zip(errors, forwards, strict=True))
    ]
    got = np.array([answer["U"] for answer in run_text(text_of(xml), calls)])
    np.testing.assert_array_equal(got, forces)
    assert plcopen_xml(text, "a < b & c") == xml
