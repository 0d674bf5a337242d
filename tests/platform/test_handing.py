"""Orders for which the control process has no room: tried again, an emergency stop first, and never lost unseen."""

from __future__ import annotations

import json

from dcon.aides.handing import NOT_TAKEN, PATIENCE_NS, STOPPED, WAITING, Handing, Reply
from dcon.aides.order_gate import Passed
from dcon.core.values import Order
from dcon.link.orders import ANSWER_NS

PATH = "/run/dcon/server.replies"


class Control:
    """Who takes datagrams while there is room."""

    def __init__(self, room: int = 0) -> None:
        self.room = room
        self.taken: list[str] = []

    def __call__(self, datagram: bytes) -> bool:
        if not self.room:
            return False
        self.room -= 1
        self.taken.append(json.loads(datagram)["name"])
        return True


def passed(name: str, order: str = "") -> Passed:
    return Passed(Order(name), None, PATH, order or name)


def refusal() -> Passed:
    """Of an order that the gate has refused, and has said so."""
    return Passed(Order("link_refused"), {"digest": "x", "refused": "too old"}, PATH)


def given_up(name: str, why: str = NOT_TAKEN) -> Reply:
    return Reply(PATH, {"digest": name, "refused": why})


def test_what_is_not_taken_is_tried_again_in_its_order() -> None:
    handing, control = Handing(), Control(1)
    for name in ("arm", "activate", "gain"):
        handing.add(passed(name), 0)
    assert handing.send(control, 0) == [] and control.taken == ["arm"] and len(handing) == 2
    control.room = 9
    assert handing.send(control, PATIENCE_NS - 1) == [] and control.taken == ["arm", "activate", "gain"]
    assert len(handing) == handing.lost == 0


def test_after_its_time_the_operator_hears_that_it_was_not_taken_and_it_is_never_sent() -> None:
    assert PATIENCE_NS < ANSWER_NS
    handing, control = Handing(), Control()
    handing.add(passed("arm"), 0)
    handing.add(refusal(), 0)
    handing.add(passed("activate"), 1)
    assert handing.send(control, PATIENCE_NS - 1) == []
    assert handing.send(control, PATIENCE_NS) == [given_up("arm")]
    control.room = 9
    assert handing.send(control, PATIENCE_NS) == [] and control.taken == ["activate"] and handing.lost == 2


def test_an_emergency_stop_goes_first_and_nothing_that_was_ordered_before_it_follows() -> None:
    handing, control = Handing(), Control()
    for one in (passed("release"), refusal(), passed("reset"), passed("estop")):
        handing.add(one, 0)
    handing.add(passed("disarm"), 0)
    assert handing.send(control, 0) == [given_up("release", STOPPED), given_up("reset", STOPPED)]
    control.room = 9
    handing.send(control, 0)
    assert control.taken == ["estop", "link_refused", "disarm"]


def test_how_many_wait_is_bounded_and_a_stop_finds_room() -> None:
    handing = Handing()
    for number in range(WAITING + 1):
        handing.add(passed("ack", str(number)), 0)
    assert handing.send(Control(), 0) == [given_up(str(WAITING))] and len(handing) == WAITING
    handing.add(passed("estop"), 0)
    control = Control(1)
    assert len(handing.send(control, 0)) == WAITING and control.taken == ["estop"]


def test_what_passed_nothing_on_is_nothing() -> None:
    handing = Handing()
    handing.add(Passed(), 0)
    assert len(handing) == 0
