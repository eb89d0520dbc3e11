'use strict';
/* A height map as a solid that can be turned: drag or arrow keys turn it, wheel, pinch or + and -
   zoom, a double click goes back. Drawn by a small rasterizer of its own on a 2-D canvas, so that
   it needs neither WebGL nor anything from a network. Parallel projection: the scale bar is exact. */
class HeightView {
  constructor(canvas, colours) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.colours = colours;
    this.colouring = 'height';
    this.pointers = new Map();
    this.reset();
    this.listen();
    new ResizeObserver(() => this.request()).observe(canvas);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.request());
  }

  reset() {
    this.azimuth = -0.6;
    this.elevation = 0.75;
    this.zoom = 1;
    this.request();
  }

  /* map: see session_report.relief() */
  show(map) {
    const {columns, rows} = map;
    const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const data = new DataView(bytes(map.heights).buffer);
    this.map = map;
    this.shape = bytes(map.shape);
    this.known = new Uint8Array(columns * rows);
    this.heights = new Float64Array(columns * rows);
    for (let i = 0; i < columns * rows; i++) {
      const value = data.getUint16(2 * i, true);
      this.known[i] = value > 0 ? 1 : 0;
      const height = map.lowest + (value - 1) / 65534 * (map.highest - map.lowest);
      this.heights[i] = value > 0 ? height : map.low;
    }
    this.wide = Math.max(columns, rows) * map.cell;
    // relief that is lower than a seventh of the width is exaggerated to it
    this.exaggerate(HeightView.roundDown(this.wide / 7 / Math.max(map.high - map.low, 1e-9)));
  }

  exaggerate(factor) {
    this.exaggeration = Math.max(1, factor);
    this.normals();
    this.request();
  }

  /* how much taller than it is, as text */
  factor() {
    return `${+this.exaggeration.toPrecision(2)}`;
  }

  colourBy(what) {
    this.colouring = what;
    this.request();
  }

  static roundDown(value) {
    const power = 10 ** Math.floor(Math.log10(value));
    return [5, 2, 1].find((m) => m * power <= value * 1.000001) * power;
  }

  normals() {
    const {columns, rows, cell} = this.map, z = this.heights, slope = this.exaggeration / cell;
    this.facing = new Float32Array(3 * columns * rows);
    for (let j = 0, i = 0; j < rows; j++) {
      for (let k = 0; k < columns; k++, i++) {
        const east = k + 1 < columns ? 1 : 0, west = k > 0 ? 1 : 0;
        const south = j + 1 < rows ? columns : 0, north = j > 0 ? columns : 0;
        const p = (z[i + east] - z[i - west]) / (east + west) * slope;
        const q = (z[i - north] - z[i + south]) / ((north + south) / columns) * slope;
        const length = Math.hypot(p, q, 1);
        this.facing[3 * i] = -p / length;
        this.facing[3 * i + 1] = -q / length;
        this.facing[3 * i + 2] = 1 / length;
      }
    }
  }

  request() {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(() => {
      this.requested = false;
      if (this.map && this.canvas.clientWidth) this.draw();
    });
  }

  draw() {
    const canvas = this.canvas;
    const density = Math.min(Math.max(window.devicePixelRatio || 1, 1.5), 2);   // finer than the screen: smooth edges
    const width = Math.round(canvas.clientWidth * density);
    const height = Math.round(canvas.clientHeight * density);
    if (canvas.width !== width || canvas.height !== height || !this.image) {
      canvas.width = width;
      canvas.height = height;
      this.image = this.context.createImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.nearness = new Float32Array(width * height);
    }
    this.pixels.fill(0);
    this.nearness.fill(-Infinity);
    this.project(width, height);
    this.surface();
    this.walls();
    this.context.putImageData(this.image, 0, 0);
    this.legend(density);
  }

  /* screen position, nearness to the eye and colour of every point, and of its foot on the base */
  project(width, height) {
    const {columns, rows, cell, low, high} = this.map;
    const [sa, ca] = [Math.sin(this.azimuth), Math.cos(this.azimuth)];
    const [se, ce] = [Math.sin(this.elevation), Math.cos(this.elevation)];
    const diagonal = Math.hypot(columns, rows) * cell;
    this.scale = Math.min(width / diagonal, height / (diagonal * 0.76)) * 0.96 * this.zoom;
    const middle = (low + high) / 2, tall = this.exaggeration;
    // light from the upper left of the viewer, turned into the frame of the part
    const light = [-0.45, 0.35, 0.82];
    const lx = light[0] * ca + light[1] * sa, ly = -light[0] * sa + light[1] * ca, lz = light[2];
    const count = columns * rows;
    if (!this.x || this.x.length !== 2 * count) {
      for (const name of ['x', 'y', 'near', 'r', 'g', 'b']) this[name] = new Float32Array(2 * count);
    }
    const foot = (low - middle) * tall - 0.05 * this.wide, span = Math.max(high - low, 1e-12);
    for (let j = 0, i = 0; j < rows; j++) {
      const v = (rows / 2 - j) * cell;
      for (let k = 0; k < columns; k++, i++) {
        const u = (k - columns / 2) * cell;
        const across = u * ca - v * sa, along = u * sa + v * ca;
        for (const [place, z] of [[i, (this.heights[i] - middle) * tall], [count + i, foot]]) {
          this.x[place] = width / 2 + this.scale * across;
          this.y[place] = height / 2 - this.scale * (along * se + z * ce);
          this.near[place] = z * se - along * ce;
        }
        const f = 3 * i, facing = this.facing;
        const lit = Math.max(0, facing[f] * lx + facing[f + 1] * ly + facing[f + 2] * lz);
        const shade = 0.28 + 0.82 * lit;
        let red = 205, green = 210, blue = 214;
        if (this.colouring === 'shape') {
          red = green = blue = this.shape[i];
        } else if (this.colouring === 'height') {
          const t = Math.min(Math.max((this.heights[i] - low) / span, 0), 1) * (this.colours.length - 1);
          const from = this.colours[Math.floor(t)], to = this.colours[Math.ceil(t)], w = t % 1;
          red = from[0] + w * (to[0] - from[0]);
          green = from[1] + w * (to[1] - from[1]);
          blue = from[2] + w * (to[2] - from[2]);
        }
        this.r[i] = red * shade;
        this.g[i] = green * shade;
        this.b[i] = blue * shade;
      }
    }
  }

  surface() {
    const {columns, rows} = this.map, known = this.known;
    for (let j = 0; j + 1 < rows; j++) {
      for (let k = 0; k + 1 < columns; k++) {
        const a = j * columns + k, b = a + 1, c = a + columns, d = c + 1;
        if (known[a] && known[b] && known[c] && known[d]) {
          this.triangle(a, b, c);
          this.triangle(b, d, c);
        }
      }
    }
  }

  /* the four sides of the solid, each of one grey */
  walls() {
    const {columns, rows} = this.map, count = columns * rows;
    const side = (start, step, steps, grey) => {
      for (let n = 0; n < steps; n++) {
        const a = start + n * step, b = a + step;
        if (!this.known[a] || !this.known[b]) continue;
        const saved = [a, b].map((p) => [p, this.r[p], this.g[p], this.b[p]]);
        for (const p of [a, b, count + a, count + b]) this.r[p] = this.g[p] = this.b[p] = grey;
        this.triangle(a, b, count + a);
        this.triangle(b, count + b, count + a);
        for (const [p, r, g, blue] of saved) [this.r[p], this.g[p], this.b[p]] = [r, g, blue];
      }
    };
    side(0, 1, columns - 1, 128);
    side((rows - 1) * columns, 1, columns - 1, 150);
    side(0, columns, rows - 1, 118);
    side(columns - 1, columns, rows - 1, 138);
  }

  triangle(i, j, k) {
    const {x, y, near, r, g, b, pixels, nearness} = this;
    const {width, height} = this.image;
    const area = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]);
    if (!area) return;
    const left = Math.max(0, Math.ceil(Math.min(x[i], x[j], x[k]) - 0.5));
    const right = Math.min(width - 1, Math.floor(Math.max(x[i], x[j], x[k]) - 0.5));
    const top = Math.max(0, Math.ceil(Math.min(y[i], y[j], y[k]) - 0.5));
    const bottom = Math.min(height - 1, Math.floor(Math.max(y[i], y[j], y[k]) - 0.5));
    for (let row = top; row <= bottom; row++) {
      for (let column = left; column <= right; column++) {
        const px = column + 0.5 - x[i], py = row + 0.5 - y[i];
        const v = (px * (y[k] - y[i]) - py * (x[k] - x[i])) / area;
        const w = (py * (x[j] - x[i]) - px * (y[j] - y[i])) / area;
        const u = 1 - v - w;
        if (u < -1e-4 || v < -1e-4 || w < -1e-4) continue;
        const depth = u * near[i] + v * near[j] + w * near[k], place = row * width + column;
        if (depth <= nearness[place]) continue;
        nearness[place] = depth;
        const red = Math.min(255, u * r[i] + v * r[j] + w * r[k]);
        const green = Math.min(255, u * g[i] + v * g[j] + w * g[k]);
        const blue = Math.min(255, u * b[i] + v * b[j] + w * b[k]);
        pixels[place] = 0xff000000 | (blue << 16) | (green << 8) | red;
      }
    }
  }

  static length(metres, metric) {
    if (!metric) return `${+metres.toPrecision(3)} px`;
    return Math.abs(metres) < 1e-3 ? `${+(metres * 1e6).toPrecision(3)} µm`
      : `${+(metres * 1e3).toPrecision(3)} mm`;
  }

  legend(density) {
    const context = this.context, metric = this.map.metric;
    const [width, height] = [this.canvas.width / density, this.canvas.height / density];
    context.setTransform(density, 0, 0, density, 0, 0);
    context.fillStyle = context.strokeStyle = getComputedStyle(this.canvas).color;
    context.font = '13px system-ui, sans-serif';
    context.textBaseline = 'alphabetic';
    const bar = HeightView.roundDown(width / 4 / (this.scale / density));
    const long = bar * this.scale / density;
    context.fillRect(16, height - 18, long, 3);
    context.textAlign = 'left';
    context.fillText(HeightView.length(bar, metric), 16, height - 24);
    if (this.exaggeration > 1) {
      context.fillText(`heights × ${this.factor()}`, 16, 24);
    }
    if (this.colouring === 'height') {
      const lowest = HeightView.length(this.map.low, metric);
      const highest = HeightView.length(this.map.high, metric);
      const right = width - 22 - context.measureText(highest).width, left = right - 84;
      const gradient = context.createLinearGradient(left, 0, right, 0);
      this.colours.forEach(([r, g, b], i) => gradient.addColorStop(
        i / (this.colours.length - 1), `rgb(${r},${g},${b})`));
      context.fillText(highest, right + 6, 24);
      context.textAlign = 'right';
      context.fillText(lowest, left - 6, 24);
      context.fillStyle = gradient;
      context.fillRect(left, 14, right - left, 11);
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  turn(across, up) {
    this.azimuth += across;
    this.elevation = Math.min(Math.PI / 2, Math.max(0.1, this.elevation + up));
    this.request();
  }

  magnify(factor) {
    this.zoom = Math.min(20, Math.max(0.5, this.zoom * factor));
    this.request();
  }

  listen() {
    const canvas = this.canvas, pointers = this.pointers;
    const spread = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    });
    canvas.addEventListener('pointermove', (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const before = pointers.size === 2 ? spread() : 0;
      const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
      pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
      if (pointers.size === 2) this.magnify(spread() / Math.max(before, 1));
      else this.turn(dx * 0.01, dy * 0.01);
    });
    for (const name of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    }
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.magnify(Math.exp(-event.deltaY * 0.0015));
    }, {passive: false});
    canvas.addEventListener('dblclick', () => this.reset());
    canvas.addEventListener('keydown', (event) => {
      const moves = {
        ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0),
        ArrowUp: () => this.turn(0, 0.1), ArrowDown: () => this.turn(0, -0.1),
        '+': () => this.magnify(1.2), '-': () => this.magnify(1 / 1.2), Home: () => this.reset()};
      if (moves[event.key]) {
        event.preventDefault();
        moves[event.key]();
      }
    });
  }
}

/* connects the view, its controls and the buttons that choose a part; see height_view.html */
(() => {
  const canvas = document.getElementById('relief');
  if (!canvas) return;
  const {maps, colours} = JSON.parse(document.getElementById('reliefs').textContent);
  const view = new HeightView(canvas, colours);
  const part = document.getElementById('part'), tall = document.getElementById('tall');
  const times = document.getElementById('times');
  const told = () => { times.value = view.factor(); };
  const choose = (number) => {
    part.value = number;
    view.show(maps[number]);
    tall.value = Math.log10(view.exaggeration);
    told();
  };
  part.addEventListener('change', () => choose(Number(part.value)));
  tall.addEventListener('input', () => {
    view.exaggerate(10 ** Number(tall.value));
    told();
  });
  document.getElementById('colouring').addEventListener(
    'change', (event) => view.colourBy(event.target.value));
  document.querySelectorAll('button[data-relief]').forEach((button) => {
    button.addEventListener('click', () => {
      choose(Number(button.dataset.relief));
      canvas.scrollIntoView({behavior: 'smooth', block: 'center'});
      canvas.focus({preventScroll: true});
    });
  });
  choose(0);
})();
