#!/usr/bin/env python3
"""Prints parameters and alerts of a structure as they come, and plots what was before.

    python3 watch.py house --connect tcp/127.0.0.1:7447
    python3 watch.py house --history storey-2 --plot storey-2.png
    python3 watch.py house --connect quic/10.0.0.5:7447 --certificate viewer.ada.pem

Needs eclipse-zenoh; a plot needs matplotlib as well.
"""

import argparse
import json
import pathlib
import sys
import time

import zenoh

# rows further apart than this many usual steps, and than so long (s), have a gap between them, as on the page
GAP_STEPS = 8
GAP_S = 1.0


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("structure")
    parser.add_argument("--root", default="spandrel", help="first chunk of all keys")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--certificate", metavar="NAME.pem", help="to show at endpoints quic/...; NAME.key and authority.pem lie beside it")
    parser.add_argument("--seconds", type=float, help="end after so long")
    parser.add_argument("--history", metavar="PARAMETER", help="ask for the past of a parameter instead")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--plot", metavar="FILE", help="draw the past to a file, such as storey-2.png")
    return parser.parse_args()


def session(endpoint, certificate):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    if certificate is not None:
        pem = pathlib.Path(certificate)
        tls = {
            "root_ca_certificate": str(pem.with_name("authority.pem")),
            "connect_certificate": str(pem),
            "connect_private_key": str(pem.with_suffix(".key")),
            "enable_mtls": True,
        }
        for key, value in tls.items():
            config.insert_json5(f"transport/link/tls/{key}", json.dumps(value))
    return zenoh.open(config)


def listen(session, below, seconds):
    def parameter(sample):
        m = json.loads(sample.payload.to_string())
        print(f"{m['parameter']} {m['mean']:.4f} ± {m['std']:.4f}", flush=True)

    def loss(sample):
        m = json.loads(sample.payload.to_string())
        print(f"{m['parameter']} loss {m['loss']:.3f}, above {m['rule_loss']} with probability {m['probability_of_loss']:.3f}", flush=True)

    def alert(sample):
        m = json.loads(sample.payload.to_string())
        print(f"ALERT {m['parameter']} {m['state']}: {m['why']}", flush=True)

    readers = {"parameter": parameter, "loss": loss, "alert": alert}
    kept = [session.declare_subscriber(f"{below}/{topic}/*", reader) for topic, reader in readers.items()]
    print(f"listening below {below}", flush=True)
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    try:
        while time.monotonic() < end:
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass
    del kept


def ask(session, below, parameter, points):
    """The rows of a parameter's history: an object of lists, see docs/topics.md#history."""
    for reply in session.get(f"{below}/history/{parameter}?points={points}", timeout=10.0):
        if reply.ok is None:
            sys.exit(f"the history refuses: {reply.err.payload.to_string()}")
        return json.loads(reply.ok.payload.to_string())
    sys.exit(f"nobody keeps a history of {below}: spandrel run and spandrel history do, spandrel demo does not")


def with_gaps(rows):
    """The columns of the plot, with a row of nothing where nothing was measured for long, so that no line leads over it."""
    columns = {"time_s": [], "low": [], "high": [], "mean": []}
    steps = sorted(after - before for before, after in zip(rows["time_s"], rows["time_s"][1:]))
    usual = steps[len(steps) // 2] if steps else 0.0
    last = None
    for row in zip(*(rows[name] for name in columns)):
        if last is not None and row[0] - last > max(GAP_STEPS * usual, GAP_S):
            for name, column in columns.items():
                column.append(last + usual if name == "time_s" else float("nan"))
        for column, value in zip(columns.values(), row):
            column.append(value)
        last = row[0]
    return columns


def plot(span, file):
    import matplotlib

    matplotlib.use("Agg")
    from datetime import datetime, timezone

    from matplotlib import pyplot

    rows = with_gaps(span["rows"])
    times = [datetime.fromtimestamp(t, timezone.utc) for t in rows["time_s"]]
    figure, axes = pyplot.subplots(figsize=(10, 4))
    axes.fill_between(times, rows["low"], rows["high"], alpha=0.3, label="95 % intervals")
    axes.plot(times, rows["mean"], label="estimate")
    axes.set_ylabel(f"{span['name']}, ratio to nominal")
    axes.set_xlabel("time (UTC)")
    axes.legend()
    figure.autofmt_xdate()
    figure.savefig(file, dpi=120)


def main():
    args = arguments()
    below = f"{args.root}/{args.structure}"
    with session(args.connect, args.certificate) as joined:
        if args.history is None:
            listen(joined, below, args.seconds)
            return
        span = ask(joined, below, args.history, args.points)
        rows = span["rows"]
        print(f"{len(rows['time_s'])} rows of {span['name']}, resolution {span['resolution_s'] or 'as displayed'}")
        if rows["time_s"]:
            print(f"last {rows['mean'][-1]:.4f} ± {rows['std'][-1]:.4f}")
        if args.plot:
            plot(span, args.plot)
            print(f"drawn to {args.plot}")


main()
