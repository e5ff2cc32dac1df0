"""A backend of matplotlib that saves a live plot to the file `PLOT` once it shows ten points."""

import os
from typing import Any

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg


class FigureCanvas(FigureCanvasAgg):
    def start_event_loop(self, timeout: float = 0) -> None:
        super().start_event_loop(timeout)
        lines: Any = self.figure.axes[0].lines
        if len(lines[0].get_xdata()) >= 10:
            self.figure.savefig(os.environ["PLOT"])
            print("plotted", len(lines[0].get_xdata()), "points", flush=True)


FigureManager = FigureManagerBase
