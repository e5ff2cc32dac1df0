"""Identifies the same records with `spandrel modes` and with pyOMA2, and prints a table of both (Markdown).

    python -m venv venv && venv/bin/pip install -r crates/bench/python/requirements-modes.txt
    cargo build --workspace --locked
    venv/bin/python crates/bench/python/modes.py target/debug/spandrel ../shared/data

pyOMA2 runs its covariance-driven method with uncertainty, at the decimated rate, with the channels, block rows, blocks
and orders of Spandrel. Each mode of Spandrel is compared with the stable poles of pyOMA2 of similar frequency and shape:
the medians of their frequency and deviation over the orders. Times are processor times of one thread, so that other load
hardly affects them. That of Spandrel includes the start of the process and the reading of the record. That of pyOMA2 is the
method alone.
"""

import os

CORE = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
os.environ.update(CORE, TQDM_DISABLE="1")  # before the libraries are loaded

import json
import logging
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from pyoma2.algorithms import SSI
from pyoma2.setup import SingleSetup

RATE_HZ = 100
# Name, file, columns (from 1), band (Hz), epoch (s), decimation, block rows.
RECORDS = [
    ("Z24, reference", "z24-damage-test/ref1-setup1.csv.gz", None, (1, 16), 640, 2, 48),
    ("Z24, pier lowered by 80 mm", "z24-damage-test/settle80mm-setup1.csv.gz", None, (1, 16), 640, 2, 48),
    ("Unison 1", "unison-tower/wn_01.dat", [3, 4, 5, 6, 7], (0.3, 8), 380, 5, 48),
    ("Unison 3", "unison-tower/wn_03.dat", [3, 4, 5, 6, 7], (0.3, 8), 380, 5, 48),
]
BLOCKS = 20
HIGHEST_ORDER = 40
# A pole belongs to a mode if the frequencies differ by less than this share, and the shapes are this similar.
NEAR = 0.02
LEAST_MAC = 0.9


def run_spandrel(program, path, columns, band, epoch_s):
    command = [program, "modes", path, "--rate", str(RATE_HZ), "--json", "--epoch", str(epoch_s)]
    command += ["--band", f"{band[0]}..{band[1]}", "--order", str(HIGHEST_ORDER)]
    if columns:
        command += ["--channels", ",".join(str(column) for column in columns)]
    start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return json.loads(said), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start


def run_pyoma(path, columns, epoch_s, decimation, block_rows):
    is_csv = ".csv" in path.name
    data = np.loadtxt(path, delimiter="," if is_csv else None, skiprows=1 if is_csv else 0)
    if columns:
        data = data[:, [column - 1 for column in columns]]
    data = data[: epoch_s * RATE_HZ]
    setup = SingleSetup(data - data.mean(axis=0), fs=RATE_HZ)
    setup.decimate_data(q=decimation)
    method = SSI(
        name="ssi", method="cov", br=block_rows, ordmax=HIGHEST_ORDER, step=2, calc_unc=True, nb=BLOCKS
    )
    setup.add_algorithms(method)
    start = time.process_time()
    setup.run_by_name("ssi")
    return method.result, time.process_time() - start


def mac(one, other):
    return abs(np.vdot(one, other)) ** 2 / (np.vdot(one, one).real * np.vdot(other, other).real)


def poles_of(result, frequency_hz, shape):
    """Returns frequency and deviation (Hz) of the stable poles that resemble a mode."""
    frequencies, deviations = result.Fn_poles, result.Fn_poles_std
    found = []
    for place in np.argwhere(result.Lab == 1):
        place = tuple(place)
        pole = result.Phi_poles[place]
        if abs(frequencies[place] / frequency_hz - 1) < NEAR and mac(pole, shape) > LEAST_MAC:
            found.append((frequencies[place], deviations[place]))
    return np.array(found)


def main():
    logging.disable(logging.INFO)
    program, data = sys.argv[1], Path(sys.argv[2])
    print("| record | Spandrel s | pyOMA2 s | mode: Spandrel Hz | pyOMA2 Hz | difference % | deviations Hz | ratio |")
    print("|---|---|---|---|---|---|---|---|")
    for name, file, columns, band, epoch_s, decimation, block_rows in RECORDS:
        path = data / file
        said, spandrel_s = run_spandrel(program, path, columns, band, epoch_s)
        result, pyoma_s = run_pyoma(path, columns, epoch_s, decimation, block_rows)
        for mode in said["modes"]:
            shape = np.array([complex(value["real"], value["imaginary"]) for value in mode["shape"]])
            poles = poles_of(result, mode["frequency_hz"], shape)
            row = f"| {name} | {spandrel_s:.2f} | {pyoma_s:.1f} | {mode['frequency_hz']:.4f} |"
            if len(poles) == 0:
                print(f"{row} none | | {mode['frequency_std_hz']:.4f} | |")
                continue
            frequency_hz, std_hz = np.median(poles, axis=0)
            difference = 100 * (mode["frequency_hz"] / frequency_hz - 1)
            ratio = mode["frequency_std_hz"] / std_hz
            print(
                f"{row} {frequency_hz:.4f} | {difference:+.2f} | {mode['frequency_std_hz']:.4f}, {std_hz:.4f} | {ratio:.2f} |"
            )


main()
