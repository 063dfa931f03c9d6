"use strict";
// The only script of a report: it sorts the table of trials and draws the trajectories of one trial.
// Texts of the data are set as text, never as markup.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const LEFT = 62, RIGHT = 14, TOP = 12, BOTTOM = 44, WIDTH = 480, HEIGHT = 240;

  function make(name, attributes, ...children) {
    const svg = ["svg", "path", "text", "title", "g"].includes(name);
    const found = svg ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes || {})) found.setAttribute(key, value);
    found.append(...children);
    return found;
  }

  function short(value, digits = 4) {
    if (!Number.isFinite(value)) return "–";
    return String(Number(value.toPrecision(digits))).replace("-", "−");
  }

  // Data: the smallest value, a step, and multiples of the step in 16 bits.

  function unpacked(line) {
    if (!line) return null;
    if (line.data === undefined) return new Array(line.n).fill(line.low);
    const bytes = Uint8Array.from(atob(line.data), (one) => one.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, k) => line.low + line.step * view.getUint16(2 * k, true));
  }

  const added = (first, second) => first.map((value, k) => value + second[k]);

  // Charts

  function ticks(low, high, count) {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 2.5, 5, 10].find((one) => one * power >= raw * (1 - 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step && found.length < 20; k++) found.push(k * step);
    return found;
  }

  function ends(values, room) {
    let low = Infinity, high = -Infinity;
    for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
    if (!(high - low > 1e-12 * Math.max(Math.abs(low), Math.abs(high)))) {
      const width = 0.5 * Math.abs(low) || 0.5;
      return [low - width, low + width];
    }
    return [low - room * (high - low), high + room * (high - low)];
  }

  function chart(title, label, times, lines) {
    const [t0, t1] = ends(times, 0), [y0, y1] = ends(lines.flatMap((line) => line.values), 0.06);
    const across = (t) => LEFT + ((t - t0) / (t1 - t0)) * (WIDTH - LEFT - RIGHT);
    const up = (y) => HEIGHT - BOTTOM - ((y - y0) / (y1 - y0)) * (HEIGHT - TOP - BOTTOM);
    const drawing = make("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", class: "chart" }, make("title", {}, title));
    for (const value of ticks(t0, t1, 5)) {
      drawing.append(make("path", { d: `M${across(value).toFixed(1)},${HEIGHT - BOTTOM}v4`, class: "axis" }));
      drawing.append(make("text", { x: across(value).toFixed(1), y: HEIGHT - BOTTOM + 18, class: "tick across" }, short(value)));
    }
    for (const value of ticks(y0, y1, 4)) {
      drawing.append(make("path", { d: `M${LEFT},${up(value).toFixed(1)}H${WIDTH - RIGHT}`, class: "grid" }));
      drawing.append(make("text", { x: LEFT - 6, y: (up(value) + 4).toFixed(1), class: "tick up" }, short(value)));
    }
    drawing.append(make("path", { d: `M${LEFT},${TOP}V${HEIGHT - BOTTOM}H${WIDTH - RIGHT}`, class: "axis" }));
    drawing.append(make("text", { x: (LEFT + WIDTH - RIGHT) / 2, y: HEIGHT - 8, class: "axis-label" }, "time [s]"));
    const middle = (TOP + HEIGHT - BOTTOM) / 2;
    drawing.append(make("text", { transform: `translate(13 ${middle}) rotate(-90)`, class: "axis-label" }, label));
    for (const line of lines) {
      const at = line.values.map((value, k) => `${across(times[k]).toFixed(1)},${up(value).toFixed(1)}`);
      drawing.append(make("path", { d: `M${at.join("L")}`, class: `line ${line.kind}` }));
    }
    const readout = make("p", { class: "readout" });
    follow(drawing, readout, times, lines, across, [t0, t1]);
    const names = make("ul", { class: "legend" }, ...lines.map(entry));
    return make("figure", {}, drawing, names, readout, make("figcaption", {}, title));
  }

  function entry(line) {
    const swatch = make("svg", { viewBox: "0 0 26 16", class: "swatch", "aria-hidden": "true" });
    swatch.append(make("path", { d: "M1,8H25", class: `line ${line.kind}` }));
    return make("li", {}, swatch, make("span", {}, line.name));
  }

  function follow(drawing, readout, times, lines, across, [t0, t1]) {
    const cursor = make("path", { class: "cursor", d: "" });
    drawing.append(cursor);
    drawing.addEventListener("pointermove", (event) => {
      const box = drawing.getBoundingClientRect();
      const share = (((event.clientX - box.left) / box.width) * WIDTH - LEFT) / (WIDTH - LEFT - RIGHT);
      const t = t0 + share * (t1 - t0);
      let k = 0;
      for (let j = 1; j < times.length; j++) if (Math.abs(times[j] - t) < Math.abs(times[k] - t)) k = j;
      cursor.setAttribute("d", `M${across(times[k]).toFixed(1)},${TOP}V${HEIGHT - BOTTOM}`);
      const values = lines.filter((line) => k < line.values.length).map((line) => `${line.name} ${short(line.values[k])}`);
      readout.textContent = `t = ${short(times[k])} s: ${values.join(", ")}`;
    });
  }

  // One trial

  const source = document.getElementById("trial-data");
  const place = document.getElementById("trial");
  const data = source ? JSON.parse(source.textContent) : { signals: [], trials: {} };

  function show(number, row) {
    const trial = data.trials[number];
    if (!trial || !place) return;
    const times = unpacked(trial.t), charts = make("div", { class: "charts pairs" });
    data.signals.forEach((signal, j) => {
      const model = unpacked(trial.m[j]), error = unpacked(trial.e[j]);
      const change = trial.c ? unpacked(trial.c[j]) : null;
      const reference = trial.r && signal.kind === "state" ? unpacked(trial.r[j]) : null;
      const values = [], errors = [];
      if (reference) values.push({ kind: "reference", name: "reference", values: reference });
      // The corrected model is drawn first, as a wide line, because it often coincides with S.
      if (change) {
        values.push({ kind: "corrected", name: "corrected model", values: added(model, change) });
        errors.push({ kind: "corrected", name: "corrected model − M", values: change });
      }
      values.push({ kind: "system", name: "system S", values: added(model, error) });
      values.push({ kind: "model", name: "model M", values: model });
      errors.push({ kind: "system", name: "S − M", values: error });
      charts.append(chart(`${signal.label} in trial ${number}`, signal.label, times, values));
      charts.append(chart(`Error of ${signal.label} in trial ${number}`, `error of ${signal.label}`, times, errors));
    });
    const where = describe(row);
    place.replaceChildren(make("div", { class: "trial-panel" }, make("h3", { tabindex: "-1" }, `Trial ${number}`), make("p", {}, where), charts));
    for (const other of document.querySelectorAll("tr[aria-current]")) other.removeAttribute("aria-current");
    if (row) row.setAttribute("aria-current", "true");
    place.querySelector("h3").focus();
  }

  function describe(row) {
    if (!row) return "";
    const names = [...row.closest("table").tHead.rows[0].cells].map((one) => one.textContent);
    return [...row.cells].slice(1).map((one, k) => [names[k + 1], one.textContent])
      .filter(([, value]) => value && value !== "–").map(([name, value]) => `${name}: ${value}`).join("; ");
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-trial]");
    const row = event.target.closest("#trials tbody tr");
    if (button) show(button.dataset.trial, button.closest("tr"));
    else if (row && row.querySelector("button[data-trial]")) show(row.querySelector("button[data-trial]").dataset.trial, row);
  });

  // Sorting

  function key(cell) {
    return cell.dataset.value === undefined ? cell.textContent : Number(cell.dataset.value);
  }

  function compared(first, second) {
    const one = typeof first === "number", two = typeof second === "number";
    if (one && two) return first - second;
    return one === two ? String(first).localeCompare(String(second)) : one ? -1 : 1;
  }

  function sort(table, header, column) {
    const down = header.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = [...table.tBodies[0].rows].sort((a, b) => compared(key(a.cells[column]), key(b.cells[column])) * (down ? -1 : 1));
    table.tBodies[0].append(...rows);
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((header, column) => {
      const button = make("button", { type: "button" }, header.textContent);
      header.replaceChildren(button);
      button.addEventListener("click", () => sort(table, header, column));
    });
  }

  // Print shows everything that is folded.

  const folded = [];
  addEventListener("beforeprint", () => {
    for (const one of document.querySelectorAll("details:not([open])")) { folded.push(one); one.open = true; }
  });
  addEventListener("afterprint", () => { for (const one of folded.splice(0)) one.open = false; });
})();
