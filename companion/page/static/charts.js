// Clearance, epsilon and speed over the last 30 or 60 s of vehicle time. A row: t, clearance, epsilon, epsilon*, speed, x, y, z.

import { colours, niceStep, prepare } from "./scene.js";

const KEEP_S = 60;
const show = (value, unit, digits = 2) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)}${unit}`);

export class Charts {
  constructor() {
    this.rows = [];
    this.span = 30;
    for (const button of document.querySelectorAll("[data-span]")) {
      button.addEventListener("click", () => {
        this.span = Number(button.dataset.span);
        document.querySelectorAll("[data-span]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
        this.draw();
      });
    }
  }

  restart(rows) {
    this.rows = rows;
  }

  add(tick) {
    const last = this.rows[this.rows.length - 1];
    if (last && tick.t < last[0]) this.rows = []; // the vehicle's clock began anew
    if (last && tick.t === last[0]) return;
    this.rows.push([tick.t, tick.clearance, tick.epsilon, tick.epsilon_star, Math.hypot(...tick.v), ...tick.p]);
    while (this.rows[0][0] < tick.t - KEEP_S) this.rows.shift();
  }

  trail() {
    return this.rows.map((row) => row.slice(5));
  }

  draw(frame = this.frame) {
    this.frame = frame;
    if (!frame || !this.rows.length) return;
    const last = this.rows[this.rows.length - 1], paint = colours();
    const least = Math.min(...this.inSpan().map((row) => row[1] ?? Infinity));
    const floor = Number.isFinite(least) ? `, least ${least.toFixed(2)} m` : "";
    this.write("now-clearance", `${show(last[1], " m")}${floor}`);
    this.write("now-epsilon", `ε ${show(last[2], "")}, ε* ${show(last[3], "")} (dashed)`);
    this.write("now-speed", `${show(last[4], " m/s")}`);
    this.plot("chart-clearance", paint, [{ column: 1, colour: paint.vehicle }], { low: -0.2, high: 2, most: 6, danger: 0, unit: "m" });
    const both = [{ column: 2, colour: paint.vehicle }, { column: 3, colour: paint.obstacle, dash: [5, 4] }];
    this.plot("chart-epsilon", paint, both, { low: 0, high: 1, unit: "" });
    this.plot("chart-speed", paint, [{ column: 4, colour: paint.vehicle }], { low: 0, high: 1, limit: frame.speed_limit, unit: "m/s" });
  }

  inSpan() {
    const end = this.rows[this.rows.length - 1][0];
    return this.rows.filter((row) => row[0] >= end - this.span);
  }

  write(id, text) {
    document.getElementById(id).textContent = text;
  }

  // axis: the least range, the greatest value worth room, a forbidden zone below `danger`, a `limit` line.
  plot(id, paint, curves, axis) {
    const canvas = document.getElementById(id), { context: c, width, height } = prepare(canvas);
    const rows = this.inSpan(), end = this.rows[this.rows.length - 1][0];
    const values = rows.flatMap((row) => curves.map((curve) => row[curve.column])).filter((v) => v !== null);
    const high = Math.min(Math.max(axis.high, ...values) * 1.08, axis.most ?? Infinity), low = Math.min(axis.low, ...values);
    const left = 30, bottom = height - 15;
    const sx = (t) => left + ((t - end + this.span) / this.span) * (width - left - 4);
    const sy = (v) => bottom - ((v - low) / (high - low)) * (bottom - 5);
    this.grid(c, paint, { width, left, bottom, high, low, sx, sy, end });
    if (axis.danger !== undefined) this.danger(c, paint, left, width - 4, sy(axis.danger), bottom);
    c.save();
    c.beginPath();
    c.rect(left, 0, width - left, bottom + 1);
    c.clip();
    if (axis.limit !== undefined && axis.limit <= high) this.line(c, [[left, sy(axis.limit)], [width, sy(axis.limit)]], paint.bad, 1, [3, 3]);
    for (const curve of curves) {
      let points = [];
      for (const row of [...rows, null]) {
        const value = row && row[curve.column];
        if (value !== null) points.push([sx(row[0]), sy(value)]);
        else { this.line(c, points, curve.colour, 2, curve.dash || []); points = []; }
      }
    }
    c.restore();
  }

  grid(c, paint, { width, left, bottom, high, low, sx, sy, end }) {
    const step = niceStep(high - low, 3);
    c.fillStyle = paint.quiet;
    c.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9; v += step) {
      this.line(c, [[left, sy(v)], [width - 4, sy(v)]], Math.abs(v) < 1e-9 ? paint.line : paint.grid, 1, []);
      c.textAlign = "right";
      if (sy(v) > 8) c.fillText(String(Number(v.toFixed(2))), left - 4, sy(v) + 4);
    }
    for (let back = 0; back <= this.span; back += this.span / 3) {
      c.textAlign = back === 0 ? "right" : back === this.span ? "left" : "center";
      c.fillText(back === 0 ? "now" : `−${back} s`, sx(end - back), bottom + 13);
    }
    c.textAlign = "left";
  }

  // What touches, hatched: it must be seen without its colour too.
  danger(c, paint, x0, x1, top, bottom) {
    if (bottom - top < 1) return;
    c.save();
    c.beginPath();
    c.rect(x0, top, x1 - x0, bottom - top);
    c.clip();
    c.globalAlpha = 0.6;
    for (let x = x0 - 20; x < x1 + 20; x += 7) this.line(c, [[x, bottom], [x + bottom - top, top]], paint.bad, 1, []);
    c.restore();
    this.line(c, [[x0, top], [x1, top]], paint.bad, 1, []);
  }

  line(c, points, colour, width, dash) {
    if (points.length < 2) return;
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.setLineDash(dash);
    c.beginPath();
    points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.stroke();
    c.setLineDash([]);
  }
}
