#!/usr/bin/env python3
"""Prints parameters, losses and alerts of a structure as they arrive, or plots past values.

    python3 watch.py house --connect tcp/127.0.0.1:7447
    python3 watch.py house --history storey-2 --plot storey-2.png
    python3 watch.py house --connect quic/10.0.0.5:7447 --certificate viewer.ada.pem

Needs the package of this folder; a plot also needs matplotlib.
"""

from __future__ import annotations

import argparse
import sys
import time

import spandrel

# Points whose distance exceeds this number of usual steps, and this time (s), have a gap between
# them, as on the page.
GAP_STEPS = 8
GAP_S = 1.0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("structure")
    parser.add_argument("--root", default=spandrel.DEFAULT_ROOT, help="first chunk of all keys")
    parser.add_argument("--connect", default=spandrel.DEFAULT_ENDPOINT, metavar="ENDPOINT")
    parser.add_argument(
        "--certificate",
        metavar="NAME.pem",
        help="certificate for endpoints quic/...; NAME.key and authority.pem must be in its folder",
    )
    parser.add_argument("--seconds", type=float, help="end after this time")
    parser.add_argument("--history", metavar="PARAMETER", help="show past values of a parameter")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument(
        "--plot", metavar="FILE", help="save a plot to a file, such as storey-2.png"
    )
    return parser.parse_args()


def show(message: spandrel.Message) -> None:
    if isinstance(message, spandrel.Parameter):
        print(f"{message.parameter} {message.mean:.4f} ± {message.std:.4f}", flush=True)
    elif isinstance(message, spandrel.Loss):
        print(
            f"{message.parameter} loss {message.loss:.3f}, above {message.rule_loss} "
            f"with probability {message.probability_of_loss:.3f}",
            flush=True,
        )
    elif isinstance(message, spandrel.Alert):
        print(f"ALERT {message.parameter} {message.state}: {message.why}", flush=True)


def listen(args: argparse.Namespace) -> None:
    kinds = [spandrel.Parameter, spandrel.Loss, spandrel.Alert]
    settings = {"connect": args.connect, "certificate": args.certificate, "root": args.root}
    end = time.monotonic() + (args.seconds if args.seconds is not None else float("inf"))
    with spandrel.subscribe(args.structure, kinds, **settings) as messages:
        print(f"listening below {args.root}/{args.structure}", flush=True)
        try:
            while time.monotonic() < end:
                message = messages.receive(timeout=0.1)
                if message is not None:
                    show(message)
        except KeyboardInterrupt:
            pass


def with_gaps(points: tuple[spandrel.Point, ...]) -> dict[str, list[float]]:
    """Returns the columns of the plot. Each gap contains a row of NaN, so that no line crosses it."""
    columns: dict[str, list[float]] = {"time_s": [], "low": [], "high": [], "mean": []}
    steps = sorted(after.time_s - before.time_s for before, after in zip(points, points[1:]))
    usual = steps[len(steps) // 2] if steps else 0.0
    last = None
    for point in points:
        if last is not None and point.time_s - last > max(GAP_STEPS * usual, GAP_S):
            for name, column in columns.items():
                column.append(last + usual if name == "time_s" else float("nan"))
        for name, column in columns.items():
            column.append(getattr(point, name))
        last = point.time_s
    return columns


def plot(past: spandrel.History, file: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from datetime import datetime, timezone

    from matplotlib import pyplot

    columns = with_gaps(past.points)
    times = [datetime.fromtimestamp(t, timezone.utc) for t in columns["time_s"]]
    figure, axes = pyplot.subplots(figsize=(10, 4))
    axes.fill_between(times, columns["low"], columns["high"], alpha=0.3, label="95 % intervals")
    axes.plot(times, columns["mean"], label="estimate")
    axes.set_ylabel(f"{past.name}, ratio to nominal")
    axes.set_xlabel("time (UTC)")
    axes.legend()
    figure.autofmt_xdate()
    figure.savefig(file, dpi=120)


def main() -> None:
    args = arguments()
    if args.history is None:
        listen(args)
        return
    past = spandrel.history(
        args.structure,
        args.history,
        points=args.points,
        connect=args.connect,
        certificate=args.certificate,
        root=args.root,
    )
    print(
        f"{len(past.points)} rows of {past.name}, resolution {past.resolution_s or 'as displayed'}"
    )
    if past.points:
        print(f"last {past.points[-1].mean:.4f} ± {past.points[-1].std:.4f}")
    if args.plot:
        plot(past, args.plot)
        print(f"plot saved to {args.plot}")


if __name__ == "__main__":
    try:
        main()
    except spandrel.SpandrelError as error:
        sys.exit(f"watch.py: {error}")
