"""The backbone over time on a canvas: play, drag, two views. Data and script stay in the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.reporting.page import Markup, Page

Floats = NDArray[np.float64]
MAX_FRAMES = 900

_CONTROLS = Markup(
    '<canvas id="backbone" width="2080" height="880"></canvas><div class="controls"><button id="backbone-play">play</button>'
    '<input id="backbone-time" type="range" min="0" value="0" aria-label="time"><output id="backbone-shown"></output></div>'
    "<noscript><p class=warning>The animation needs JavaScript; the figures below do not.</p></noscript>"
)

_SCRIPT = """
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("backbone-data").textContent);
  const canvas = document.getElementById("backbone"), pen = canvas.getContext("2d");
  const slider = document.getElementById("backbone-time"), shown = document.getElementById("backbone-shown");
  const button = document.getElementById("backbone-play");
  const views = [["z (mm)", "y (mm)", 2, 1], ["z (mm)", "x (mm)", 2, 0]];
  const low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
  const point = (p) => { for (let i = 0; i < 3; i++) { low[i] = Math.min(low[i], p[i]); high[i] = Math.max(high[i], p[i]); } };
  data.frames.forEach((f) => f.points.forEach(point));
  slider.max = data.frames.length - 1;
  const half = canvas.width / 2, margin = 70;
  const across = Math.max(high[2] - low[2], 1), up = Math.max(high[1] - low[1], high[0] - low[0], 1);
  const scale = Math.min((half - 2 * margin) / across, (canvas.height - 2 * margin) / up);
  function place(p, view) {
    const [, , a, b] = views[view];
    return [view * half + margin + (p[a] - low[2]) * scale,
            canvas.height / 2 - (p[b] - (low[b] + high[b]) / 2) * scale];
  }
  function dot(p, view, colour, radius) {
    if (!p) return;
    pen.beginPath(); pen.arc(...place(p, view), radius, 0, 7); pen.fillStyle = colour; pen.fill();
  }
  function draw(k) {
    const frame = data.frames[k];
    pen.fillStyle = "#fff"; pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.font = "24px sans-serif";
    for (let view = 0; view < 2; view++) {
      pen.fillStyle = "#57606a";
      pen.fillText(views[view][0], view * half + half - 130, canvas.height - 24);
      pen.fillText(views[view][1], view * half + 20, 36);
      let from = Math.max(0, k - data.trail);
      pen.strokeStyle = "#cf222e55"; pen.lineWidth = 2; pen.beginPath();
      for (let j = from; j <= k; j++) {
        const [x, y] = place(data.frames[j].points.at(-1), view);
        j === from ? pen.moveTo(x, y) : pen.lineTo(x, y);
      }
      pen.stroke();
      pen.strokeStyle = "#cf222e"; pen.lineWidth = 5; pen.lineJoin = "round"; pen.beginPath();
      frame.points.forEach((p, i) => { const [x, y] = place(p, view); i ? pen.lineTo(x, y) : pen.moveTo(x, y); });
      pen.stroke();
      dot(frame.open_loop, view, "#0969da", 8);
      dot(frame.tracker, view, "#57606a", 6);
      const bar = 10 ** Math.floor(Math.log10(across / 3));
      pen.fillStyle = "#1b1f24"; pen.fillRect(view * half + margin, canvas.height - 40, bar * scale, 4);
      pen.fillText(bar + " mm", view * half + margin, canvas.height - 52);
    }
    shown.textContent = frame.t.toFixed(2) + " s";
    slider.value = k;
    document.documentElement.dataset.frame = k;
  }
  let playing = false, began = 0, first = 0;
  function tick(now) {
    if (!playing) return;
    const t = first + (now - began) / 1000;
    let k = data.frames.findIndex((f) => f.t >= t);
    if (k < 0) { k = data.frames.length - 1; stop(); }
    draw(k);
    if (playing) requestAnimationFrame(tick);
  }
  function stop() { playing = false; button.textContent = "play"; }
  button.onclick = () => {
    if (playing) { stop(); return; }
    let k = +slider.value; if (k >= data.frames.length - 1) k = 0;
    playing = true; button.textContent = "pause"; began = performance.now(); first = data.frames[k].t;
    requestAnimationFrame(tick);
  };
  slider.oninput = () => { stop(); draw(+slider.value); };
  draw(0);
  document.documentElement.dataset.animation = "ready";
  document.documentElement.dataset.frames = data.frames.length;
})();
"""


def add_animation(
    page: Page,
    t: Floats,
    shapes: Sequence[Floats],
    open_loop: Sequence[Floats | None],
    tracker: Sequence[Floats | None],
) -> None:
    """Put an animation into the page.

    Args:
        t: (n,) s. shapes: n backbones (points, 3), m. open_loop, tracker: n points (3,) m, or None.
    """
    every = max(1, -(-len(t) // MAX_FRAMES))
    frames = [
        {
            "t": round(float(t[k]), 4),
            "points": _millimetres(shapes[k]),
            "open_loop": None if open_loop[k] is None else _millimetres(open_loop[k]),
            "tracker": None if tracker[k] is None else _millimetres(tracker[k]),
        }
        for k in range(0, len(t), every)
    ]
    if frames:
        page.add(_CONTROLS)
        page.data("backbone-data", {"frames": frames, "trail": 30})
        page.script(_SCRIPT)


def _millimetres(points: Any) -> Any:
    return np.round(1e3 * np.asarray(points, float), 2).tolist()
