// Draws one instant in a plane: x, y (plan) or distance along the route, altitude (side). World in metres, ENU.

export function colours() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  const names = ["card", "ink", "quiet", "line", "grid", "vehicle", "target", "obstacle", "keep", "sigma", "path", "ref", "safe", "bad", "arena"];
  return Object.fromEntries(names.map((name) => [name, read(name)]));
}

// Sets the canvas to the screen's pixels; returns its context, in CSS pixels, and its size.
export function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "12px system-ui, 'DejaVu Sans', sans-serif";
  context.lineJoin = "round";
  return { context, width, height };
}

export function niceStep(span, lines) {
  const raw = span / Math.max(1, lines), power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].find((factor) => factor * power >= raw * 0.999) * power;
}

const decimals = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

// plane: across(p), up(p) give the plane's coordinates of a world point; spread(c) its covariance [aa, ab, bb].
export class Scene {
  constructor(canvas, camera, plane, paint) {
    Object.assign(this, { camera, plane, paint, labels: [] }, prepare(canvas));
  }

  at(p) {
    return [this.sx(this.plane.across(p)), this.sy(this.plane.up(p))];
  }

  sx(a) { return this.width / 2 + (a - this.camera.a) * this.camera.scale; }
  sy(b) { return this.height / 2 - (b - this.camera.b) * this.camera.scale; }

  grid() {
    const { context: c, width, height, camera, paint } = this;
    const step = niceStep(width / camera.scale, Math.max(6, width / 75)), digits = decimals(step);
    c.lineWidth = 1;
    c.strokeStyle = paint.grid;
    c.fillStyle = paint.quiet;
    const left = camera.a - width / 2 / camera.scale, bottom = camera.b - height / 2 / camera.scale;
    for (let a = Math.ceil(left / step) * step; this.sx(a) < width; a += step) {
      this.line([[this.sx(a), 0], [this.sx(a), height]]);
      if (this.sx(a) > 34) c.fillText(a.toFixed(digits), this.sx(a) + 3, height - 4);
    }
    for (let b = Math.ceil(bottom / step) * step; this.sy(b) > 0; b += step) {
      this.line([[0, this.sy(b)], [width, this.sy(b)]]);
      if (this.sy(b) < height - 18 && this.sy(b) > 30) c.fillText(b.toFixed(digits), 3, this.sy(b) - 3);
    }
  }

  axes([across, up]) {
    const { context: c, width, height, paint } = this;
    c.textAlign = "right";
    this.text(across, width - 5, height - 18, paint.quiet, true);
    c.textAlign = "left";
    this.text(up, 5, 13, paint.quiet, true);
  }

  line(points, close = false) {
    const c = this.context;
    c.beginPath();
    points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    if (close) c.closePath();
    c.stroke();
  }

  box(low, high) {
    const { context: c, paint } = this;
    const [x0, y0] = [this.sx(low[0]), this.sy(low[1])], [x1, y1] = [this.sx(high[0]), this.sy(high[1])];
    c.strokeStyle = paint.arena;
    c.lineWidth = 1.5;
    c.setLineDash([9, 4, 2, 4]);
    c.strokeRect(x0, y1, x1 - x0, y0 - y1);
    c.setLineDash([]);
    const inside = (v, size) => v > 0 && v < size;
    if (inside(x0, this.width) || inside(y1, this.height)) {
      this.text("arena", Math.max(70, x0 + 6), Math.max(15, y1 + 15), paint.quiet, true);
    }
  }

  trail(points) {
    const { context: c, paint } = this;
    c.strokeStyle = paint.vehicle;
    c.lineWidth = 2;
    c.globalAlpha = 0.55;
    this.line(points.map((p) => this.at(p)));
    c.globalAlpha = 1;
  }

  route(points, from) {
    const { context: c, paint } = this;
    if (!points.length) return;
    c.strokeStyle = paint.target;
    c.lineWidth = 1;
    c.setLineDash([2, 5]);
    this.line([from, ...points].map((p) => this.at(p)));
    c.setLineDash([]);
    c.fillStyle = paint.target;
    points.forEach((p, i) => {
      const [x, y] = this.at(p), last = i === points.length - 1;
      this.star(x, y, last ? 9 : 6, last ? 5 : 4);
      if (points.length > 1) this.text(String(i + 1), x + 8, y - 6, paint.target);
    });
  }

  star(x, y, size, rays) {
    const c = this.context;
    c.beginPath();
    for (let k = 0; k < 2 * rays; k++) {
      const r = k % 2 ? 0.42 * size : size, angle = (Math.PI * k) / rays - Math.PI / 2;
      c.lineTo(x + r * Math.cos(angle), y + r * Math.sin(angle));
    }
    c.closePath();
    c.fill();
  }

  mark(p) {
    const { context: c, paint } = this;
    const [x, y] = this.at(p);
    c.strokeStyle = paint.target;
    c.lineWidth = 2;
    c.beginPath();
    c.arc(x, y, 9, 0, 2 * Math.PI);
    c.stroke();
    this.line([[x - 13, y], [x + 13, y]]);
    this.line([[x, y - 13], [x, y + 13]]);
  }

  disc(x, y, radius, fill, stroke) {
    const c = this.context;
    c.beginPath();
    c.arc(x, y, Math.max(0.5, radius), 0, 2 * Math.PI);
    if (fill) { c.fillStyle = fill; c.fill(); }
    if (stroke) { c.strokeStyle = stroke; c.stroke(); }
  }

  // The keep-out distance D about the obstacle where its row's last step has it, one ring a part.
  keepOut(track, binding) {
    const keep = track.keep_out, { context: c, paint, camera } = this;
    if (!keep) return;
    const [x, y] = this.at(keep.centre);
    let inner = track.radius, outer = keep.radii;
    for (const [part, alpha] of [["radii", 0.3], ["cushion", 0.2], ["sigma", 0.26], ["delay", 0.14]]) {
      if (part !== "radii") { inner = outer; outer += keep[part]; }
      c.globalAlpha = binding ? alpha : 0.35 * alpha;
      c.fillStyle = paint.keep;
      c.beginPath();
      c.arc(x, y, Math.max(0.1, outer * camera.scale), 0, 2 * Math.PI);
      c.arc(x, y, Math.max(0.1, Math.min(inner, outer) * camera.scale), 0, 2 * Math.PI, true);
      c.fill();
      c.globalAlpha = binding ? 0.75 : 0.4;
      c.strokeStyle = paint.keep;
      c.lineWidth = 0.75;
      this.disc(x, y, outer * camera.scale, null, paint.keep);
    }
    c.globalAlpha = binding ? 1 : 0.8;
    c.lineWidth = binding ? 3 : 1.25;
    c.setLineDash(binding ? [] : [6, 4]);
    this.disc(x, y, outer * camera.scale, null, paint.keep);
    c.globalAlpha = 1;
    c.lineWidth = 1;
    c.setLineDash([2, 2]);
    this.disc(x, y, track.radius * camera.scale, null, paint.obstacle);
    c.setLineDash([]);
  }

  obstacle(track) {
    const { context: c, paint, camera } = this;
    const [x, y] = this.at(track.p), tentative = track.status === "tentative";
    if (track.path.length) {
      c.strokeStyle = paint.path;
      c.lineWidth = 2.5;
      c.lineCap = "round";
      c.setLineDash([0.1, 5]);
      this.line([track.p, ...track.path].map((p) => this.at(p)));
      c.setLineDash([]);
      c.lineCap = "butt";
    }
    c.globalAlpha = tentative ? 0.35 : track.status === "coasting" ? 0.65 : 1;
    c.lineWidth = 1.5;
    this.disc(x, y, Math.max(3, track.radius * camera.scale), paint.obstacle, tentative ? paint.ink : null);
    c.globalAlpha = 1;
    this.ellipse(x, y, this.plane.spread(track.covariance), 2, track.radius);
    const speed = Math.hypot(...track.v);
    if (speed > 0.05) this.arrow(track.p, track.v, 0.5, paint.obstacle, 2);
  }

  // Beside the obstacle, where no other label is.
  label(track) {
    const words = track.status === "confirmed" ? track.id : `${track.id} (${track.status})`;
    const [x, y] = this.at(track.p), gap = Math.max(3, track.radius * this.camera.scale) * 0.75 + 4;
    const width = this.context.measureText(words).width;
    const places = [[gap, -gap], [gap, gap + 10], [-gap - width, -gap], [-gap - width, gap + 10], [gap, -gap - 15], [gap, gap + 25]];
    const boxes = places.map(([dx, dy]) => [x + dx, y + dy - 11, x + dx + width, y + dy + 3]);
    const meets = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
    const inside = (box) => box[0] >= 0 && box[2] <= this.width && box[1] >= 0 && box[3] <= this.height;
    const box = boxes.find((one) => inside(one) && !this.labels.some((other) => meets(one, other))) || boxes[0];
    this.labels.push(box);
    this.text(words, box[0], box[3] - 3, this.paint.ink, true);
  }

  // An ellipse of k sigma of a 2x2 covariance, about an obstacle of this radius.
  ellipse(x, y, [aa, ab, bb], k, radius) {
    const { context: c, paint, camera } = this;
    const mean = (aa + bb) / 2, root = Math.hypot((aa - bb) / 2, ab);
    const major = k * Math.sqrt(Math.max(0, mean + root)), minor = k * Math.sqrt(Math.max(0, mean - root));
    if (major < radius && radius * camera.scale < 9) return; // it would only hide a small disc
    c.beginPath();
    c.ellipse(x, y, major * camera.scale, minor * camera.scale, -0.5 * Math.atan2(2 * ab, aa - bb), 0, 2 * Math.PI);
    const hidden = major < radius; // on the obstacle's disc its own colour would not be seen
    if (!hidden) {
      c.strokeStyle = paint.card;
      c.lineWidth = 3;
      c.globalAlpha = 0.65;
      c.stroke();
      c.globalAlpha = 1;
    }
    c.strokeStyle = hidden ? paint.card : paint.sigma;
    c.lineWidth = 1.5;
    c.setLineDash([3, 2]);
    c.stroke();
    c.setLineDash([]);
  }

  // From p along v for the given seconds; dashed where dash is given.
  arrow(p, v, seconds, colour, width, dash = []) {
    const c = this.context;
    const end = p.map((x, i) => x + v[i] * seconds);
    const [x0, y0] = this.at(p), [x1, y1] = this.at(end);
    const length = Math.hypot(x1 - x0, y1 - y0);
    if (length < 6) return;
    const [ux, uy] = [(x1 - x0) / length, (y1 - y0) / length], head = Math.min(8, 0.5 * length);
    c.strokeStyle = c.fillStyle = colour;
    c.lineWidth = width;
    c.setLineDash(dash);
    this.line([[x0, y0], [x1 - ux * head, y1 - uy * head]]);
    c.setLineDash([]);
    c.beginPath();
    c.moveTo(x1, y1);
    c.lineTo(x1 - ux * head - uy * head * 0.5, y1 - uy * head + ux * head * 0.5);
    c.lineTo(x1 - ux * head + uy * head * 0.5, y1 - uy * head - ux * head * 0.5);
    c.fill();
  }

  vehicle(tick, radius, nose) {
    const { context: c, paint, camera } = this;
    const [x, y] = this.at(tick.p);
    this.arrow(tick.p, tick.v, 0.5, paint.vehicle, 2.5);
    if (tick.u_ref) this.arrow(tick.p, tick.u_ref, 0.35, paint.ref, 2.5, [5, 3]);
    if (tick.u_safe) this.arrow(tick.p, tick.u_safe, 0.35, paint.safe, 2.5);
    c.globalAlpha = 0.25;
    this.disc(x, y, radius * camera.scale, paint.vehicle, null);
    c.globalAlpha = 1;
    c.lineWidth = 1.5;
    this.disc(x, y, radius * camera.scale, null, paint.vehicle);
    const size = Math.min(13, Math.max(8, 0.8 * radius * camera.scale));
    c.save();
    c.translate(x, y);
    c.rotate(-nose);
    c.beginPath();
    [[1, 0], [-0.8, 0.7], [-0.4, 0], [-0.8, -0.7]].forEach(([a, b]) => c.lineTo(a * size, b * size));
    c.closePath();
    c.fillStyle = paint.vehicle;
    c.strokeStyle = paint.card;
    c.lineWidth = 1.5;
    c.fill();
    c.stroke();
    c.restore();
  }

  // Obstacles out of sight: a mark at the edge, with the distance.
  outside(track, from) {
    const [x, y] = this.at(track.p), { context: c, paint, width, height } = this;
    if (x >= 0 && x <= width && y >= 0 && y <= height) return;
    const ex = Math.min(width - 14, Math.max(14, x)), ey = Math.min(height - 26, Math.max(22, y));
    c.save();
    c.translate(ex, ey);
    c.rotate(Math.atan2(y - ey, x - ex));
    c.fillStyle = paint.obstacle;
    c.beginPath();
    [[9, 0], [-5, 6], [-5, -6]].forEach(([a, b]) => c.lineTo(a, b));
    c.fill();
    c.restore();
    const away = Math.hypot(...track.p.map((q, i) => q - from[i]));
    c.textAlign = ex > width / 2 ? "right" : "left";
    this.text(`${track.id} ${away.toFixed(0)} m`, ex + (ex > width / 2 ? -12 : 12), ey + 4, paint.ink, true);
    c.textAlign = "left";
  }

  text(words, x, y, colour, halo = false) {
    const { context: c, paint } = this;
    if (halo) {
      c.strokeStyle = paint.card;
      c.lineWidth = 3;
      c.strokeText(words, x, y);
    }
    c.fillStyle = colour;
    c.fillText(words, x, y);
  }
}
