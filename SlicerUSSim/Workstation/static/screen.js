// Screens: draws images where they belong, fitted, zoomed, moved or flipped, with ruler, marks and measurements. One
// place() for all of them, from millimetres in the probe frame to pixels, so that they share one ruler.
(() => {
  const INK = "#b9c2c9";
  const MARGIN = { left: 44, right: 44, top: 12, bottom: 12 };
  const LETTERS = 12;
  const DRAWN_ON = { "real-over": "simulated" }; // streams without a separate screen
  const view = { zoom: 1, x: 0, y: 0, flipX: false, flipY: false }; // x, y: pixels by which images are moved
  const images = {}; // by stream: { bitmap, meta }
  const screens = { view, images, drawMarks: () => {} };
  window.ussimScreens = screens;

  const canvasOf = (stream) => document.querySelector(`canvas[data-stream="${stream}"]`);
  const screenOf = (name) => document.querySelector(`[data-screen="${name}"]`);

  screens.add = (parent, name, attributes = {}, text = "") => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.textContent = text;
    parent.append(element);
    return element;
  };

  // The image of a screen on its pixels: { scale, toPx, toMm, edges }, or null without one.
  screens.place = (name) => {
    const ruler = images[name]?.meta?.ruler;
    const screen = screenOf(name);
    if (!ruler || !screen?.clientWidth) return null;
    const [width, height] = [screen.clientWidth, screen.clientHeight];
    const room = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
    const scale = Math.max(Math.min(room[0] / ruler.w, room[1] / ruler.h), 0.1) * view.zoom;
    const [sx, sy] = [view.flipX ? -scale : scale, view.flipY ? -scale : scale];
    const middle = [MARGIN.left + room[0] / 2 + view.x, MARGIN.top + room[1] / 2 + view.y];
    const origin = [middle[0] - sx * (ruler.x + ruler.w / 2), middle[1] - sy * (ruler.y + ruler.h / 2)];
    const toPx = (x, y) => [origin[0] + sx * x, origin[1] + sy * y];
    const [a, b] = [toPx(ruler.x, ruler.y), toPx(ruler.x + ruler.w, ruler.y + ruler.h)];
    return {
      scale, sx, sy, origin, ruler, width, height, toPx,
      toMm: (left, top) => [(left - origin[0]) / sx, (top - origin[1]) / sy],
      edges: { left: Math.min(a[0], b[0]), right: Math.max(a[0], b[0]), top: Math.min(a[1], b[1]), bottom: Math.max(a[1], b[1]) },
    };
  };

  // The screen under an event and the point in millimetres, or null.
  screens.at = (event) => {
    const screen = event.target.closest?.("[data-screen]");
    const place = screen && screens.place(screen.dataset.screen);
    if (!place) return null;
    const box = screen.getBoundingClientRect();
    const mm = place.toMm(event.clientX - box.left, event.clientY - box.top);
    const { x, y, w, h } = place.ruler;
    const isInMm = place.ruler.ticks?.length !== 0; // else the size of a pixel is not known
    return { screen: screen.dataset.screen, mm, isInMm, isInside: mm[0] >= x && mm[0] <= x + w && mm[1] >= y && mm[1] <= y + h };
  };

  // Take a new image of a stream, or null for none, and draw it.
  screens.put = (stream, bitmap, meta) => {
    images[stream]?.bitmap?.close();
    images[stream] = bitmap ? { bitmap, meta } : null;
    screens.draw(stream);
  };

  screens.draw = (stream) => {
    const [canvas, image, name] = [canvasOf(stream), images[stream], DRAWN_ON[stream] ?? stream];
    const context = canvas?.getContext("2d", { alpha: false });
    const place = image && screens.place(name);
    if (!context) return;
    const dense = window.devicePixelRatio || 1;
    const size = [Math.round(canvas.clientWidth * dense), Math.round(canvas.clientHeight * dense)];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#000";
    context.fillRect(0, 0, canvas.width, canvas.height);
    if (image && !screenOf(name)) context.drawImage(image.bitmap, 0, 0, canvas.width, canvas.height); // M-mode: no ruler
    if (place) {
      const { ruler, sx, sy, origin } = place;
      context.setTransform(sx * dense, 0, 0, sy * dense, origin[0] * dense, origin[1] * dense);
      context.drawImage(image.bitmap, ruler.x, ruler.y, ruler.w, ruler.h);
    }
    if (!screenOf(stream)) return;
    overlay(name);
    const frame = screenOf(name).querySelector(".ussim-frame");
    if (!frame || !place) return;
    const { left, top, right, bottom } = place.edges;
    Object.assign(frame.style, { left: `${left}px`, top: `${top}px`, width: `${right - left}px`, height: `${bottom - top}px` });
    frame.classList.toggle("mirrored-x", view.flipX);
    frame.classList.toggle("mirrored-y", view.flipY);
  };

  screens.redraw = () => Object.keys(images).forEach(screens.draw);

  // (rows, columns) of an image as it came, for programs that control the page: [[rows, columns], grey levels in base 64].
  screens.pixels = (stream) => {
    const { bitmap } = images[stream];
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    const { data } = canvas.getContext("2d").getImageData(0, 0, bitmap.width, bitmap.height);
    let text = "";
    for (let n = 0; n < data.length; n += 4) text += String.fromCharCode(data[n]);
    return [[bitmap.height, bitmap.width], btoa(text)];
  };

  // ---- zoom, move, flip ------------------------------------------------------------------------------------------

  screens.zoomAt = (event, factor) => {
    const screen = event.target.closest?.("[data-screen]");
    const place = screen && screens.place(screen.dataset.screen);
    if (!place) return;
    const box = screen.getBoundingClientRect();
    const [left, top] = [event.clientX - box.left, event.clientY - box.top];
    const mm = place.toMm(left, top);
    view.zoom = Math.min(Math.max(view.zoom * factor, 1), 12);
    const [x, y] = screens.place(screen.dataset.screen).toPx(...mm);
    [view.x, view.y] = view.zoom === 1 ? [0, 0] : [view.x + left - x, view.y + top - y];
    screens.redraw();
  };
  screens.move = (dx, dy) => {
    [view.x, view.y] = [view.x + dx, view.y + dy];
    screens.redraw();
  };
  screens.flip = (axis) => {
    if (axis === "x") view.flipX = !view.flipX;
    else view.flipY = !view.flipY;
    screens.redraw();
  };
  screens.fit = () => {
    [view.zoom, view.x, view.y] = [1, 0, 0];
    screens.redraw();
  };

  // ---- ruler and marks -------------------------------------------------------------------------------------------

  function overlay(name) {
    const svg = screenOf(name).querySelector("svg");
    svg.replaceChildren();
    const place = images[name] && screens.place(name);
    if (!place) return;
    screens.add(svg, "rect", { width: place.width, height: place.height, fill: "transparent" });
    depthRuler(svg, place);
    orientation(svg, place);
    if (name === "simulated") greyBar(svg, place);
    screens.drawMarks(svg, name, place);
  }

  const text = (parent, x, y, words, more = {}) =>
    screens.add(parent, "text", { x, y, fill: INK, "font-size": LETTERS, "font-family": "sans-serif", ...more }, words);

  function depthRuler(svg, { ruler, toPx, edges, width }) {
    const left = Math.min(edges.right + 8, width - 34);
    const group = screens.add(svg, "g", { class: "depth-ruler", stroke: INK, "stroke-width": 1 });
    const [from, to] = [toPx(0, Math.max(ruler.y, 0))[1], toPx(0, ruler.y + ruler.h)[1]];
    screens.add(group, "line", { x1: left, x2: left, y1: from, y2: to });
    for (const tick of ruler.ticks ?? []) {
      const y = toPx(0, tick.y)[1];
      screens.add(group, "line", { x1: left, x2: left + (tick.text ? 7 : 4), y1: y, y2: y });
      if (tick.text) text(group, left + 9, y + 4, tick.text, { stroke: "none" });
    }
    if (!ruler.focus || ruler.focus > ruler.y + ruler.h) return;
    const y = toPx(0, ruler.focus)[1];
    const mark = screens.add(group, "path", { class: "focus-mark", d: `M ${left} ${y} l -9 -5 v 10 z`, fill: "#ffc83d", stroke: "none" });
    screens.add(mark, "title", {}, "Transmit focus");
  }

  function orientation(svg, { edges, width, height }) {
    const beside = 124; // the values in the corner
    const x = view.flipX ? Math.min(edges.right - 14, width - beside) : Math.max(edges.left + 14, beside);
    const y = Math.min(Math.max(view.flipY ? edges.bottom - 14 : edges.top + 14, 14), height - 14);
    const mark = screens.add(svg, "circle", { class: "orientation-mark", cx: x, cy: y, r: 7, fill: "#ff9d2e" });
    screens.add(mark, "title", {}, "Side of the probe's ridge");
  }

  function greyBar(svg, { ruler, height }) {
    const tall = Math.min(0.28 * height, 180);
    const top = height - tall - 28;
    const group = screens.add(svg, "g", { class: "grey-bar" });
    const greys = screens.add(screens.add(group, "defs"), "linearGradient", { id: "ussim-greys", x1: 0, x2: 0, y1: 0, y2: 1 });
    screens.add(greys, "stop", { offset: 0, "stop-color": "#fff" });
    screens.add(greys, "stop", { offset: 1, "stop-color": "#000" });
    screens.add(group, "rect", { x: 8, y: top, width: 9, height: tall, fill: "url(#ussim-greys)", stroke: "#555" });
    text(group, 6, top - 4, "0 dB");
    text(group, 6, top + tall + 14, `−${ruler.range}`);
  }

  new ResizeObserver(() => screens.redraw()).observe(document.documentElement);
  // Screens get another size when others are shown; they exist once the page is built.
  screens.observe = () => {
    const observer = new ResizeObserver(() => screens.redraw());
    for (const screen of document.querySelectorAll("[data-screen]")) observer.observe(screen);
  };
})();
