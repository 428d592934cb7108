"""The one table of orders, service/commands.toml: REST and the command line are made of it."""

import json
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest
from pydantic import TypeAdapter, ValidationError

from pyrcal.client import remote
from service.records.commands import Command
from service.records.operations import DitherPurpose
from service.tracking import interlocks
from service.web.commands import ORDERS, OrderRoute

PATHS = json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text("utf-8"))[
    "paths"
]
TYPED = [one for one in remote.REQUESTS if one.permitted]


def test_every_command_has_its_route():
    kinds = [kind for order in ORDERS.values() for kind in order.kinds]
    assert set(kinds) == set(get_args(Command))
    twice = {kind.__name__ for kind in kinds if kinds.count(kind) > 1}
    assert twice == {"GiveUp"}  # of a matrix that the RTC measures, and of a noisy one


def test_the_id_of_a_noisy_matrix_is_that_of_its_dither():
    assert ORDERS["measure_noisy"].makes == DitherPurpose.NOISY


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_rest_has_the_route_and_where_to_look_afterwards(order):
    described = PATHS[order.path][order.method.lower()]
    assert described["security"][0] == {"bearer": [order.scope.value]}
    for path in order.follows.values():
        assert "get" in PATHS[path]
    assert ("412" in described["responses"]) is bool(order.decides_on)


@pytest.mark.parametrize("request_", TYPED, ids=lambda request: request.name)
def test_the_command_line_says_what_the_command_has(request_):
    order = next(one for one in ORDERS.values() if one.call == request_.call)
    known = {field.name for kind in order.kinds for field in fields(kind)}
    assert {*request_.body, *request_.always} <= known
    assert request_.permitted in interlocks.ORDERS


@pytest.mark.parametrize("wrong", [{"scope": "all"}, {"decide_on": []}, {"call": None}])
def test_what_the_table_does_not_know_is_refused(wrong):
    said = {"call": "POST /v1/x", "command": "Refit", "text": ""}
    with pytest.raises(ValidationError, match="|".join(wrong)):
        TypeAdapter(OrderRoute).validate_python(said | wrong)
