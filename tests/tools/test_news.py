"""Why nothing came of an endpoint: said from the news of its connection."""

from __future__ import annotations

import pytest

from pmutools.cli.news import News
from pmutools.host import ClockStep, Stall
from pmutools.net.dialogue import LinkEvent, LinkKind
from pmutools.timebase import NS
from pmutools.tools.news import Reasons, told

URL = "tcp://192.0.2.1:4712"


def event(kind: LinkKind, detail: str = "", owners: tuple[int, ...] = (0,), idcode: int | None = None) -> LinkEvent:
    return LinkEvent(kind, URL, owners, detail, idcode)


@pytest.mark.parametrize(
    ("news", "why"),
    [
        ([], "nothing came; is the sender on"),
        ([event(LinkKind.BOUND, "receive buffer 1 bytes")], "nothing came; is the sender on"),
        ([event(LinkKind.CONNECTED)], "connected, but nothing came; a device answers to its own IDCODE only, name it"),
        ([event(LinkKind.CONNECTED, idcode=7)], "connected, but nothing came; a device answers to its own IDCODE only"),
        ([event(LinkKind.FAILED, f"{URL}: refused: nothing serves this port")], "refused: nothing serves this port"),
        ([event(LinkKind.FAILED, "no"), event(LinkKind.CONNECTED)], "connected, but nothing came"),
        ([event(LinkKind.CONNECTED), event(LinkKind.UNANSWERED, f"{URL}: no configuration came")], "no configuration"),
        ([event(LinkKind.CONNECTED), event(LinkKind.CONFIGURED, "CFG2")], "a configuration came, but no data"),
        ([event(LinkKind.NO_CONFIG, "held until one comes")], "data came, but no configuration that fits them: held"),
        (
            [event(LinkKind.FOREIGN, "IDCODE 7 comes"), event(LinkKind.NOTHING, "nothing has come")],
            "nothing came that was asked for: IDCODE 7 comes",
        ),
        ([event(LinkKind.FAILED, "no"), event(LinkKind.OWN_DROPS, "full")], "no"),
        ([event(LinkKind.STREAMING), event(LinkKind.SILENT)], "data have stopped coming"),
    ],
)
def test_why(news: list[LinkEvent], why: str) -> None:
    reasons = Reasons()
    for one in news:
        reasons.hear(one)
    assert reasons.why().startswith(why)
    assert reasons.why(1).startswith("nothing came; is the sender on")


def test_every_kind_of_news_has_words() -> None:
    for kind in LinkKind:
        reasons = Reasons()
        reasons.hear(event(kind, "detail", (3, 5)))
        assert reasons.why(3) == reasons.why(5) != ""
        assert "{" not in reasons.why(3)
        assert told(event(kind, f"{URL}: detail")) == f"{kind}: detail"
    assert told(event(LinkKind.SILENT)) == "silent"


def test_what_the_machine_did_is_told_where_it_may_matter() -> None:
    happened = [Stall(0, 0, 80_000_000), Stall(0, 0, 3 * NS), ClockStep(0, 0, -2_500_000)]
    words = [
        "the measuring host stood still for 80 ms",
        "the measuring host stood still for 3000 ms",
        "the receiver's clock was set by -2.500 ms",
    ]
    for verbose, expected in ((0, words[1:]), (1, words)):
        said: list[str] = []
        news = News(said.append, verbose)
        for each in happened:
            news.host(each)
        assert said == expected
