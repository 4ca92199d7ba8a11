"""Which obstacles refused the reference, and what their rows say about the answer: the filter's rows, built again."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.explain.moment import Moment
from companion.safety.adapt import decay_interval
from companion.safety.barrier import BarrierRows
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.task import Task
from companion.tracking.tracks import BoolArray, Rows
from companion.types import FloatArray, Vec3, frozen

_HOLDS_M_S2 = 1e-6  # rows broken by less are not


@dataclass(frozen=True, slots=True)
class Refusal:
    """One obstacle's rows at the reference and at the answer."""

    track: str
    refused: bool  # no epsilon admits the reference
    shortfall_m_s2: float  # how far the reference breaks its tightest row at the epsilon that asks least of it
    by_braking: bool  # only the braking distance refused it
    step: int  # of that row
    broken: bool  # nor does one admit the answer
    inside_m: float  # how far the answer comes inside the distance kept, over the horizon, predicted; 0: it does not


def refusals(moment: Moment) -> list[Refusal]:
    """Of every confirmed track, those that refused the reference first, the hardest first; empty without a filter."""
    record, prediction = moment.record, moment.prediction
    if prediction is None or not len(prediction) or record.u_ref is None or record.u_safe is None:
        return []
    if moment.config.safety.filter == "none":
        return []
    a_ref, a_safe = frozen(record.u_ref), frozen(record.u_safe)
    task = _task(moment, a_ref)
    rows = task.rows
    refused, shortfall, steps = _at(rows, a_ref)
    broken, *_ = _at(rows, a_safe)
    stops = None if task.stops is None else task.stops.slack(a_ref)
    gap = rows.keep_out_m - np.sqrt(np.add.reduce(rows.positions(a_safe) ** 2))
    inside = np.maximum(gap.max(axis=-1), 0.0)
    found = []
    for j, name in enumerate(rows.ids):
        stop = math.inf if stops is None else float(stops[j])
        by_braking = stop < -_HOLDS_M_S2 and not refused[j]
        found.append(
            Refusal(
                track=name,
                refused=bool(refused[j]) or by_braking,
                shortfall_m_s2=max(0.0, -stop if by_braking else float(shortfall[j])),
                by_braking=by_braking,
                step=int(steps[j]),
                broken=bool(broken[j]),
                inside_m=float(inside[j]),
            )
        )
    return sorted(found, key=lambda one: (not one.refused, -one.shortfall_m_s2))


def _task(moment: Moment, a_ref: Vec3) -> Task:
    """The program of the tick as the filter built it, about the reference."""
    config, (p, v) = moment.config, moment.at
    assert moment.prediction is not None
    return SafetyFilter(config.safety, config.limits).build(
        FilterInput(
            p_enu=p,
            v_enu=v,
            a_ref=a_ref,
            prediction=moment.prediction,
            p_std_m=moment.inputs.vehicle.p_std_m,
            limits_on=moment.inputs.task != "stay",
            accel_shrink_m_s2=config.limits.acceleration_m_s2 - config.reference_limit_m_s2,
            elapsed_s=moment.elapsed_s,
            a_before=moment.before,
        )
    )


def _at(rows: BarrierRows, a: Vec3) -> tuple[BoolArray, FloatArray, Rows]:
    """Whether no decay admits ``a``, how far it breaks the tightest row at the kindest, and which, (M,)."""
    values = rows.evaluate(a)
    lower, upper = decay_interval(values, rows.least_decay)
    decay = np.clip(np.where(lower <= upper, upper, 0.5 * (lower + upper)), 0.0, 1.0)
    rise, psi = values
    _, norm = rows.gradient(a, decay)
    slack = (rise + decay[:, None] * psi) / norm
    return lower > upper + 1e-9, -slack.min(axis=-1), slack.argmin(axis=-1)
