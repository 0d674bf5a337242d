"""Loss models against their long-run ratios, burst lengths and transition rules."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import pytest
from support.impairment import pipeline, play

from pmutools.draws import Draws
from pmutools.impair.losses import FourState, loss_model
from pmutools.impair.moment import Moment
from pmutools.impair.outgoing import Fate
from pmutools.impair.stages import parse_setting
from pmutools.timebase import NS

N = 200_000


def lost(
    text: str, count: int = N, period_ns: int = NS // 60, seed: int = 1
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """1 for each lost frame."""
    model = loss_model(text).lost(Draws(seed, "N1", "loss"))
    return np.array([int(model(Moment(index, index * period_ns))) for index in range(count)])


def runs(flags: np.ndarray[tuple[int], np.dtype[np.int64]], value: int) -> list[int]:
    """Lengths of the runs of ``value`` that begin and end inside."""
    inner = [(key, len(list(group))) for key, group in groupby(flags.tolist())][1:-1]
    return [length for key, length in inner if key == value]


def batch_error(flags: np.ndarray[tuple[int], np.dtype[np.int64]]) -> float:
    """Standard error of the mean of a correlated sequence, from the spread of 100 batch means."""
    return float(np.mean(np.split(flags, 100), axis=1).std(ddof=1) / 10)


@pytest.mark.parametrize("p", [0.001, 0.05, 0.5])
def test_bernoulli(p: float) -> None:
    flags = lost(str(p))
    assert abs(flags.mean() - p) < 5 * math.sqrt(p * (1 - p) / N)
    bursts = runs(flags, 1)
    assert abs(np.mean(bursts) - 1 / (1 - p)) < 5 * math.sqrt(p) / (1 - p) / math.sqrt(len(bursts)) + 1e-12
    assert np.array_equal(flags, lost(f"bernoulli({p})"))


def test_certain_and_impossible() -> None:
    assert lost("0%", 2000).sum() == 0
    assert lost("100%", 2000).sum() == 2000


@pytest.mark.parametrize(("loss", "burst"), [(0.01, 5.0), (0.05, 2.0), (0.2, 10.0)])
def test_simple_gilbert_by_its_design_rule(loss: float, burst: float) -> None:
    """r = 1/B and p = L r/(1-L) lose the share L in bursts of B frames."""
    r = 1 / burst
    flags = lost(f"gemodel({loss * r / (1 - loss)}, {r})")
    memory = 1 - r - loss * r / (1 - loss)
    error = math.sqrt(loss * (1 - loss) / N * (1 + memory) / (1 - memory))
    assert abs(flags.mean() - loss) < 5 * error
    bursts, gaps = runs(flags, 1), runs(flags, 0)
    assert abs(np.mean(bursts) - burst) < 5 * math.sqrt(1 - r) * burst / math.sqrt(len(bursts))
    assert abs(np.mean(gaps) - (1 - loss) / loss * burst) < 5 * np.mean(gaps) / math.sqrt(len(gaps))


def test_gilbert_elliott_in_full() -> None:
    p, r, bad, good = 0.02, 0.1, 0.6, 0.01
    flags = lost(f"gemodel({p}, {r}, {bad}, good={good})")
    assert abs(flags.mean() - (p * bad + r * good) / (p + r)) < 5 * batch_error(flags)


def test_gilbert_with_one_parameter_is_bernoulli() -> None:
    flags = lost("gemodel(10%)")
    assert abs(flags.mean() - 0.1) < 5 * math.sqrt(0.09 / N)
    assert abs(np.corrcoef(flags[1:], flags[:-1])[0, 1]) < 5 / math.sqrt(N)


FOUR_STATE = "state(2%, 20%, 10%, 30%, 1%)"


def test_four_state_long_run() -> None:
    flags = lost(FOUR_STATE)
    share = 1 / (1 + 0.01 + 0.1 * (1 + 0.1 / 0.3))
    assert abs(flags.mean() - share * (0.1 + 0.01)) < 5 * batch_error(flags)
    model = loss_model(FOUR_STATE)
    assert isinstance(model, FourState)
    assert math.isclose(sum(model.stationary()), 1)
    assert math.isclose(model.stationary()[0], share)


def test_four_state_by_its_rule() -> None:
    """A plain simulation of the transition rule, on the same draws."""
    state, expected = 1, list[int]()
    u = Draws(1, "N1", "loss").uniforms(0, 2000)
    fresh = lost(FOUR_STATE, 2000)
    for value in u.tolist():
        if state == 1:
            state = 4 if value < 0.01 else 3 if value < 0.03 else 1
        elif state == 2:
            state = 3 if value < 0.3 else 2
        elif state == 3:
            state = 2 if value < 0.1 else 1 if value < 0.1 + 0.2 else 3
        else:
            state = 1
        expected.append(int(state in (3, 4)))
    begin = next(
        index
        for index in range(2000)
        if index > 100 and fresh[index - 5 : index].sum() == 0 == sum(expected[index - 5 : index])
    )
    assert fresh[begin:].tolist() == expected[begin:]


def test_four_state_defaults_are_bernoulli() -> None:
    flags = lost("state(10%)")
    assert abs(flags.mean() - 0.1) < 5 * math.sqrt(0.09 / N)


def test_on_off_by_stream_time() -> None:
    on, off, total = 5.0, 1.0, N / 60
    flags = lost(f"onoff({on}, {off})")
    error = math.sqrt(2 * (on * off) ** 2 / (on + off) ** 3 / total)
    assert abs(flags.mean() - off / (on + off)) < 5 * error
    for value, mean in ((1, off), (0, on)):
        seconds = np.array(runs(flags, value)) / 60
        assert abs(seconds.mean() - mean) < 5 * mean / math.sqrt(len(seconds)) + 1 / 60
    denser = lost(f"onoff({on}, {off})", 2000, NS // 600)
    assert np.array_equal(denser[::10], flags[:200])


def test_on_off_looks_back() -> None:
    model = loss_model("onoff(1, 1)").lost(Draws(1, "N1", "loss"))
    straight = [model(Moment(0, second * NS // 4)) for second in range(400)]
    assert [model(Moment(0, second * NS // 4)) for second in (399, 3, 200, 0)] == [
        straight[k] for k in (399, 3, 200, 0)
    ]


def test_periodic() -> None:
    flags = lost("periodic(2, 0.5, offset=1)", 600)
    seconds = np.arange(600) * (NS // 60) / NS
    expected = (seconds >= 1) & ((seconds - 1) % 2.5 >= 2)
    assert np.array_equal(flags, expected)


def test_named_frames() -> None:
    assert np.flatnonzero(lost("every(7, 3)", 30)).tolist() == [3, 10, 17, 24]
    assert np.flatnonzero(lost("list(2, 5-7, every 10 offset 1)", 30)).tolist() == [1, 2, 5, 6, 7, 11, 21]
    assert np.flatnonzero(lost("trace(0, 0, 1)", 9)).tolist() == [2, 5, 8]


def test_parts_are_independent_processes() -> None:
    faults = parse_setting("loss", "5%\n10% when=every 2")
    assert len(faults.parts) == 2
    rows = play(pipeline("loss=5%\n10% when=every 2"), 5000)
    fates = np.array([row.fate is Fate.LOST for row in rows])
    for parity, p in ((0, 1 - 0.95 * 0.9), (1, 0.05)):
        assert abs(fates[parity::2].mean() - p) < 5 * math.sqrt(p * (1 - p) / 2500)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5", "5 is not a probability; did you mean 5%?"),
        ("gemdel(1%)", "'gemdel' is no loss model; did you mean 'gemodel'?"),
        ("gemodel(0, 0)", "gemodel: p and r are both 0, so the chain never moves; use a probability alone"),
        ("state(60%, 20%, 0, 1, 50%)", "state: p13 + p14, and p31 + p32, must not exceed 100%"),
        ("state(5%, 0)", "state: a burst would never end; p31 (and p23, with p32) must be above 0"),
        ("state(5%, 10%, 10%, 0)", "state: a burst would never end; p31 (and p23, with p32) must be above 0"),
        ("trace(0, 2)", "trace values: 2 is out of range; it must be 0 to 1"),
        ("periodic(0, 0)", "periodic: on and off are both 0"),
        ("every(0)", "every n: 0 is out of range; it must be at least 1"),
        ("5% when=sometimes", "when: 'sometimes' is not an index, a range like 50-59, or 'every 100 offset 3'"),
    ],
)
def test_errors(text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_setting("loss", text)
    assert str(error.value) == message
