"""Which drone visits which points in which order: OR-tools' local search for the least longest
route.
"""

import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from skyquilt.errors import PIP, UsageError
from skyquilt.planning.records import Array

UNIT = 100
"""Units of time per second: OR-tools counts in whole numbers."""
GOAL = 0.97
"""The goal of every route's duration, in shares of the mean that the search starts with: what a
route exceeds it by counts once more, which is smoother than the longest route alone.
"""
LONGEST = 1.6
"""Longest time of a search over the time of the processor that it may use: beside other work a
search goes on for longer, so that its routes are as good.
"""
MOST_SEARCHED = 1500
"""Points beyond which a divided tour is taken as it is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Vehicle:
    """One sortie of a drone."""

    times: Array
    """(n, n) between points in s, each with the photo at its end."""
    out: Array
    """(n,) from the ground to a point, its photo included."""
    home: Array
    """(n,) from a point to the ground."""
    usable: float
    """Largest duration in s."""

    def length(self, route: Sequence[int]) -> float:
        """Duration of a route in s; 0 for none."""
        if not len(route):
            return 0.0
        r = np.asarray(route)
        return float(self.out[r[0]] + self.times[r[:-1], r[1:]].sum() + self.home[r[-1]])


def solver() -> Any:
    """OR-tools' routing library; UsageError where it is not installed."""
    try:
        from ortools.constraint_solver import pywrapcp
    except ImportError:
        raise UsageError(
            "planning routes needs OR-tools, which is not installed; it is the extra `plan`:"
            f' {PIP} install -c constraints.txt ".[plan]" in the folder of the source'
        ) from None
    return pywrapcp


def tours(vehicles: Sequence[Vehicle], seconds: float) -> list[list[int]] | None:
    """The order of points (0 to n - 1) of each vehicle; None where their means do not suffice.

    A tour through all points is divided among the vehicles; from there the search goes on for
    `seconds` of the processor's time.
    """
    library = solver()
    n = len(vehicles[0].out)
    with _interrupts() as heard:
        whole = _one_tour(library, vehicles[0], min(0.25 * seconds, 4.0), heard)
    start = divided(vehicles, whole)
    if n > MOST_SEARCHED:
        return start if _fits(vehicles, start) else None
    with _interrupts() as heard:
        found = _searched(library, vehicles, start, seconds, heard)
    options = [r for r in (start, found) if r is not None and _fits(vehicles, r)]
    return min(options, key=lambda r: _longest(vehicles, r), default=None)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Gives a list that is no longer empty once Ctrl-C was pressed, which ends a search: what is
    raised in a function that OR-tools calls is lost. It is raised afterwards.
    """
    heard: list[int] = []
    former = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(former):
        yield heard
        return
    signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, former)
    if heard:
        former(signal.SIGINT, None)


def _fits(vehicles: Sequence[Vehicle], routes: Sequence[Sequence[int]]) -> bool:
    return all(v.length(r) <= v.usable for v, r in zip(vehicles, routes, strict=True))


def _longest(vehicles: Sequence[Vehicle], routes: Sequence[Sequence[int]]) -> float:
    return max(v.length(r) for v, r in zip(vehicles, routes, strict=True))


def _one_tour(library: Any, vehicle: Vehicle, seconds: float, heard: list[int]) -> list[int]:
    """A short closed tour through all points."""
    n = len(vehicle.out)
    if n < 4:
        return list(range(n))
    manager = library.RoutingIndexManager(n, 1, 0)
    model = library.RoutingModel(manager)
    whole = np.rint(np.minimum(vehicle.times, vehicle.times.T) * UNIT).astype(np.int64)
    model.SetArcCostEvaluatorOfAllVehicles(model.RegisterTransitMatrix(whole.tolist()))
    parameters = _parameters(library, model, seconds, heard, guided=n <= MOST_SEARCHED)
    found = model.SolveWithParameters(parameters)
    if found is None:
        return list(range(n))
    order, at = [], model.Start(0)
    while not model.IsEnd(at):
        order.append(manager.IndexToNode(at))
        at = found.Value(model.NextVar(at))
    return order


def divided(vehicles: Sequence[Vehicle], order: Sequence[int]) -> list[list[int]]:
    """A closed tour cut so that the longest route is short: every few starts, both directions, the
    limit found by halving.
    """
    n, best, chosen = len(order), np.inf, None
    for way in (list(order), list(order)[::-1]):
        for shift in range(0, n, max(1, n // 40)):
            turned = way[shift:] + way[:shift]
            low, high = 0.0, min(best, _most(vehicles, turned))
            while high - low > 0.005 * high:
                middle = (low + high) / 2
                routes = _filled(vehicles, turned, middle)
                if routes is None:
                    low = middle
                else:
                    high = middle
                    if middle < best:
                        best, chosen = middle, routes
    return chosen if chosen is not None else _even(vehicles, order)


def _even(vehicles: Sequence[Vehicle], order: Sequence[int]) -> list[list[int]]:
    cuts = np.array_split(np.asarray(order), len(vehicles))
    return [c.tolist() for c in cuts]


def _most(vehicles: Sequence[Vehicle], order: Sequence[int]) -> float:
    """A limit that is enough."""
    routes = zip(vehicles, _even(vehicles, order), strict=True)
    return 1.001 * max(v.length(r) for v, r in routes)


def _filled(
    vehicles: Sequence[Vehicle], order: Sequence[int], limit: float
) -> list[list[int]] | None:
    """Each vehicle takes from the tour as much as fits under the limit; None where points are
    left.
    """
    at, sequence = 0, np.asarray(order)
    routes: list[list[int]] = []
    for vehicle in vehicles:
        rest = sequence[at:]
        if not len(rest):
            routes.append([])
            continue
        legs = np.concatenate([[vehicle.out[rest[0]]], vehicle.times[rest[:-1], rest[1:]]])
        ends = np.cumsum(legs) + vehicle.home[rest]
        fits = np.flatnonzero(ends <= limit)
        count = int(fits[-1]) + 1 if len(fits) else 0
        routes.append(rest[:count].tolist())
        at += count
    return routes if at == len(sequence) else None


def _parameters(library: Any, model: Any, seconds: float, heard: list[int], *, guided: bool) -> Any:
    from ortools.constraint_solver import routing_enums_pb2 as names

    parameters = library.DefaultRoutingSearchParameters()
    parameters.first_solution_strategy = names.FirstSolutionStrategy.PATH_CHEAPEST_ARC
    if guided:
        parameters.local_search_metaheuristic = names.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    seconds = max(seconds, 0.05)
    end = time.process_time() + seconds
    over = model.solver().CustomLimit(lambda: bool(heard) or time.process_time() > end)
    model.AddSearchMonitor(over)
    parameters.time_limit.FromMilliseconds(int(LONGEST * seconds * 1000))
    return parameters


def _searched(
    library: Any,
    vehicles: Sequence[Vehicle],
    start: list[list[int]],
    seconds: float,
    heard: list[int],
) -> list[list[int]] | None:
    n, k = len(vehicles[0].out), len(vehicles)
    # nodes: points, then the ground (each vehicle has its own legs from and to it)
    manager = library.RoutingIndexManager(n + 1, k, n)
    model = library.RoutingModel(manager)
    kinds: dict[int, int] = {}
    evaluators = []
    for vehicle in vehicles:
        if id(vehicle.times) not in kinds:
            table = np.zeros((n + 1, n + 1))
            table[:n, :n], table[n, :n], table[:n, n] = vehicle.times, vehicle.out, vehicle.home
            whole = np.minimum(np.rint(table * UNIT), 1e12).astype(np.int64)
            kinds[id(vehicle.times)] = model.RegisterTransitMatrix(whole.tolist())
        evaluators.append(kinds[id(vehicle.times)])
    for number, evaluator in enumerate(evaluators):
        model.SetArcCostEvaluatorOfVehicle(evaluator, number)
    limits = [int(v.usable * UNIT) for v in vehicles]
    model.AddDimensionWithVehicleTransitAndCapacity(evaluators, 0, limits, True, "time")
    duration = model.GetDimensionOrDie("time")
    goal = int(UNIT * GOAL * sum(v.length(r) for v, r in zip(vehicles, start, strict=True)) / k)
    for number in range(k):
        duration.SetCumulVarSoftUpperBound(model.End(number), goal, 1)
    parameters = _parameters(library, model, seconds, heard, guided=True)
    model.CloseModelWithParameters(parameters)
    first = model.ReadAssignmentFromRoutes(start, True)
    found = (
        model.SolveFromAssignmentWithParameters(first, parameters)
        if first is not None
        else model.SolveWithParameters(parameters)
    )
    return None if found is None else _read(model, manager, found, k)


def _read(model: Any, manager: Any, found: Any, vehicles: int) -> list[list[int]]:
    """The routes of a solution."""
    routes = []
    for number in range(vehicles):
        order, at = [], found.Value(model.NextVar(model.Start(number)))
        while not model.IsEnd(at):
            order.append(manager.IndexToNode(at))
            at = found.Value(model.NextVar(at))
        routes.append(order)
    return routes
