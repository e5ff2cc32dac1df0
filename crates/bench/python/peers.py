"""Runs the same filter of the same building in Python, with filterpy and with plain NumPy. Both use expm of SciPy.

Reads the building and its samples (JSON, written by the benchmark `peers`) and prints one line of JSON for each filter:
name, times of the steps with a prediction (s), and the last mean of the state. Versions are those of requirements.txt:

    python -m venv venv && venv/bin/pip install -r crates/bench/python/requirements.txt
    cargo bench -p spandrel-bench --bench peers -- --python venv/bin/python

The equations are those of the benchmark's dense filter: one exponential of [[A, g, B], [0, 0, 0]] Δt holds the transition and
the integrals of the inputs, P = λ (A Σ Aᵀ + B σ² Bᵀ), then the textbook update.
"""

import json
import sys
import time

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg import expm


class Building:
    """A chain of equal masses on equal springs with Rayleigh damping; state: displacements, velocities, ratios."""

    def __init__(self, case):
        self.n = case["storeys"]
        self.mass, self.stiffness = case["mass"], case["stiffness"]
        self.alpha, self.beta, self.step = case["alpha"], case["beta"], case["step"]
        self.sensed = np.array(case["sensed"])
        # drift of a storey from the displacements of its floors
        self.drift = np.eye(self.n) - np.eye(self.n, k=-1)

    def linearise(self, y):
        n = self.n
        x, v, theta, alpha, beta = y[:n], y[n : 2 * n], y[2 * n : 3 * n], self.alpha * y[-2], self.beta * y[-1]
        k = self.stiffness * theta
        by_mass = self.drift.T @ (k[:, None] * self.drift) / self.mass
        jacobian = np.zeros((3 * n + 2, 3 * n + 2))
        jacobian[:n, n : 2 * n] = np.eye(n)
        jacobian[n : 2 * n, :n] = -by_mass
        jacobian[n : 2 * n, n : 2 * n] = -beta * by_mass - alpha * np.eye(n)
        stretched = self.drift @ (x + beta * v)
        jacobian[n : 2 * n, 2 * n : 3 * n] = -self.drift.T * (self.stiffness * stretched) / self.mass
        jacobian[n : 2 * n, 3 * n] = -self.alpha * v
        jacobian[n : 2 * n, 3 * n + 1] = -self.beta * (by_mass @ v)
        rate = np.concatenate([v, -by_mass @ (x + beta * v) - alpha * v, np.zeros(n + 2)])
        return jacobian, rate

    def discretise(self, y):
        n = 3 * self.n + 2
        jacobian, rate = self.linearise(y)
        augmented = np.zeros((n + 2, n + 2))
        augmented[:n, :n] = jacobian
        augmented[:n, n] = rate
        augmented[self.n : 2 * self.n, n + 1] = -1.0
        exponential = expm(augmented * self.step)
        return exponential[:n, :n], exponential[:n, n], exponential[:n, n + 1]

    def observe(self, y):
        """Absolute accelerations, which the ground motion itself does not enter."""
        return self.linearise(y)[1][self.n + self.sensed]

    def observation_jacobian(self, y):
        return self.linearise(y)[0][self.n + self.sensed]


class WithFilterpy:
    name = "filterpy"

    def __init__(self, building, case):
        self.building, self.fading, self.level = building, case["fading"], case["ground_std"] ** 2
        self.filter = ExtendedKalmanFilter(dim_x=3 * building.n + 2, dim_z=len(building.sensed))
        self.filter.x = np.array(case["prior_mean"])
        self.filter.P = np.diag(np.array(case["prior_std"]) ** 2)
        self.filter.R = np.eye(len(building.sensed)) * case["sensor_std"] ** 2

    def predict(self):
        transition, increment, inputs = self.building.discretise(self.filter.x)
        self.filter.F = np.sqrt(self.fading) * transition
        self.filter.Q = self.fading * self.level * np.outer(inputs, inputs)
        self.filter.predict_x = lambda u=0: None
        mean = self.filter.x + increment
        self.filter.predict()
        self.filter.x = mean

    def update(self, samples):
        self.filter.update(samples, self.building.observation_jacobian, self.building.observe)

    def mean(self):
        return self.filter.x


class WithNumpy:
    name = "numpy"

    def __init__(self, building, case):
        self.building, self.fading, self.level = building, case["fading"], case["ground_std"] ** 2
        self.x = np.array(case["prior_mean"])
        self.p = np.diag(np.array(case["prior_std"]) ** 2)
        self.r = np.eye(len(building.sensed)) * case["sensor_std"] ** 2

    def predict(self):
        transition, increment, inputs = self.building.discretise(self.x)
        self.x = self.x + increment
        self.p = self.fading * (transition @ self.p @ transition.T + self.level * np.outer(inputs, inputs))

    def update(self, samples):
        h = self.building.observation_jacobian(self.x)
        p_ht = self.p @ h.T
        gain = np.linalg.solve(h @ p_ht + self.r, p_ht.T).T
        self.x = self.x + gain @ (samples - self.building.observe(self.x))
        self.p = self.p - gain @ p_ht.T

    def mean(self):
        return self.x


def main():
    with open(sys.argv[1]) as file:
        case = json.load(file)
    frames = np.array(case["frames"])
    for peer in (WithFilterpy, WithNumpy):
        filter = peer(Building(case), case)
        filter.update(frames[0])
        times = []
        for samples in frames[1:]:
            start = time.perf_counter()
            filter.predict()
            filter.update(samples)
            times.append(time.perf_counter() - start)
        print(json.dumps({"name": filter.name, "times": times, "mean": filter.mean().tolist()}))


main()
