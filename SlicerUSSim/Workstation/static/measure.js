// Tools on the image: calipers, text, body mark, M-mode, dual image; pictures with banner, scale and measurements.
// Points are millimetres in the probe frame, so that measurements stay on the structures at any zoom.
(() => {
  const INK = "#7ee08a";
  const BANNER = 26;
  const POINTS = { distance: 2, ellipse: 3, angle: 3, depth: 1, text: 1, mmode: 2 };
  const screens = window.ussimScreens;
  const marks = []; // { kind, screen, points, text }
  let drawing = null; // a mark whose points are not all there yet
  let line = null; // of the M-mode
  let hasBodyMark = false;

  const away = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
  const trame = () => window.trame;

  function ellipse([a, b, side]) {
    const half = away(a, b) / 2;
    const middle = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    const turn = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const across = side ? Math.abs((side[1] - middle[1]) * Math.cos(turn) - (side[0] - middle[0]) * Math.sin(turn)) : 0;
    return { middle, half, across, turn };
  }

  // What a mark measures, in words.
  function words({ kind, points, text }) {
    if (kind === "text") return text;
    if (kind === "depth") return `depth ${points[0][1].toFixed(1)} mm`;
    if (points.length < POINTS[kind]) return "";
    if (kind === "distance") return `${away(...points).toFixed(1)} mm`;
    if (kind === "angle") {
      const [a, apex, b] = points;
      const turn = Math.atan2(a[1] - apex[1], a[0] - apex[0]) - Math.atan2(b[1] - apex[1], b[0] - apex[0]);
      return `${((Math.acos(Math.cos(turn)) * 180) / Math.PI).toFixed(1)}°`;
    }
    const { half, across } = ellipse(points);
    return `${(2 * half).toFixed(1)} × ${(2 * across).toFixed(1)} mm, ${(Math.PI * half * across).toFixed(0)} mm²`;
  }

  // ---- drawing ---------------------------------------------------------------------------------------------------

  screens.drawMarks = (svg, name, place) => {
    const all = drawing ? [...marks, drawing] : marks;
    for (const mark of all.filter((one) => one.screen === name)) draw(svg, mark, place);
    if (line && name === "simulated") draw(svg, { kind: "mmode", points: line }, place);
    if (hasBodyMark && name === "simulated") bodyMark(svg, place);
  };

  function draw(svg, mark, place) {
    const group = screens.add(svg, "g", { class: `mark ${mark.kind}`, stroke: INK, "stroke-width": 1.5, fill: "none" });
    const points = mark.points.map((point) => place.toPx(...point));
    for (const [x, y] of mark.kind === "text" ? [] : points) {
      screens.add(group, "path", { d: `M ${x - 5} ${y} h 10 M ${x} ${y - 5} v 10` });
    }
    if (mark.kind === "ellipse" && points.length > 1) {
      const { middle, half, across, turn } = ellipse(mark.points);
      const [x, y] = place.toPx(...middle);
      const sign = Math.sign(place.sx * place.sy);
      screens.add(group, "ellipse", {
        cx: x, cy: y, rx: half * place.scale, ry: across * place.scale, transform: `rotate(${(sign * turn * 180) / Math.PI} ${x} ${y})`,
      });
    } else if (points.length > 1) {
      screens.add(group, "polyline", { points: points.join(" "), "stroke-dasharray": mark.kind === "mmode" ? "6 4" : "2 3" });
    }
    const [x, y] = points[points.length - 1];
    const label = { x: x + 9, y: y - 7, fill: INK, stroke: "none", "font-size": 14, "font-family": "sans-serif" };
    screens.add(group, "text", label, mark.kind === "mmode" ? "M" : words(mark));
  }

  // The head from above with the probe on it, as sonographers mark their images.
  function bodyMark(svg, { height, width }) {
    const pose = trame().state.get(document.getElementById("screens").dataset.pose);
    if (!pose) return;
    const group = screens.add(svg, "g", { class: "body-mark", transform: `translate(${width - 92} ${height - 52})`, stroke: "#dfe5e8", fill: "none" });
    screens.add(group, "ellipse", { rx: 28, ry: 34 });
    screens.add(group, "path", { d: "M -6 -33 L 0 -41 L 6 -33" });
    // From above the patient's right is on the right of the picture, as the nose is up
    const [x, y] = [(28 * pose.right_deg) / 120, (-34 * pose.front_deg) / 120];
    const probe = screens.add(group, "g", { transform: `translate(${x} ${y}) rotate(${pose.rotate_deg})`, stroke: INK });
    screens.add(probe, "line", { x1: -9, x2: 9, "stroke-width": 4 });
    screens.add(probe, "circle", { cx: -9, r: 3, fill: "#ff9d2e", stroke: "none" });
  }

  // ---- tools -----------------------------------------------------------------------------------------------------

  function tool(kind) {
    document.querySelector(".ussim-typed")?.remove();
    drawing = null;
    if (kind === "clear") marks.length = 0;
    else if (kind === "bodymark") hasBodyMark = !hasBodyMark;
    else if (kind === "mmode-off") showLine(null);
    else if (kind) drawing = { kind, screen: "", points: [] };
    document.getElementById("screens").classList.toggle("measuring", Boolean(drawing));
    screens.redraw();
  }

  function showLine(points) {
    line = points;
    document.getElementById("mmode").hidden = !points;
    trame().trigger("mmode", [points ? points.flat() : null]);
  }

  function clicked(event) {
    const where = screens.at(event);
    if (!drawing || !where?.isInMm || event.button) return;
    event.preventDefault();
    if (drawing.points.length && where.screen !== drawing.screen) return; // a distance is within one image
    drawing.screen = where.screen;
    drawing.points = [...drawing.points.filter((_, n) => n < (drawing.set ?? 0)), where.mm];
    drawing.set = drawing.points.length;
    if (drawing.set < POINTS[drawing.kind]) return screens.redraw();
    const { kind, screen, points } = drawing;
    if (kind === "text") return typeText(event, { kind, screen, points });
    tool(null);
    if (kind === "mmode") showLine(points);
    else marks.push({ kind, screen, points });
    screens.redraw();
  }

  function moved(event) {
    const where = screens.at(event);
    if (!drawing?.set || !where || where.screen !== drawing.screen) return;
    drawing.points = [...drawing.points.slice(0, drawing.set), where.mm];
    screens.redraw();
  }

  function typeText(event, mark) {
    tool(null);
    const field = document.createElement("input");
    field.className = "ussim-typed";
    field.setAttribute("aria-label", "Text on the image");
    Object.assign(field.style, { left: `${event.clientX}px`, top: `${event.clientY - 12}px` });
    field.addEventListener("keydown", (key) => {
      if (key.key === "Escape") field.value = "";
      if (key.key === "Enter" || key.key === "Escape") field.blur();
    });
    field.addEventListener("blur", () => {
      if (field.value.trim()) marks.push({ ...mark, text: field.value.trim() });
      field.remove();
      screens.redraw();
    });
    document.body.append(field);
    field.focus();
  }

  // The last mark, or the last point of the one that is drawn, is taken back.
  function takeBack() {
    if (drawing) tool(null);
    else marks.pop();
    screens.redraw();
  }

  // Measurements are of the image that was frozen; live images are others.
  function unfrozen() {
    marks.splice(0, marks.length, ...marks.filter((mark) => mark.screen === "kept"));
  }

  function dual() {
    const kept = document.querySelector("[data-screen=kept]");
    const image = screens.images.simulated;
    if (!kept.hidden || !image) {
      kept.hidden = true;
      screens.put("kept", null);
      marks.splice(0, marks.length, ...marks.filter((mark) => mark.screen !== "kept"));
      return;
    }
    const canvas = new OffscreenCanvas(image.bitmap.width, image.bitmap.height);
    canvas.getContext("2d").drawImage(image.bitmap, 0, 0);
    kept.hidden = false;
    const { patient, time } = image.meta;
    const values = [...document.querySelectorAll("#image-values div")].map((one) => one.textContent.trim()).join(", ");
    document.getElementById("kept-caption").textContent = `Kept: ${patient}, ${time.slice(11, 19)} UTC, ${values}`;
    marks.push(...marks.filter((mark) => mark.screen === "simulated").map((mark) => ({ ...mark, screen: "kept" })));
    screens.put("kept", canvas.transferToImageBitmap(), image.meta);
  }

  // ---- pictures for others ---------------------------------------------------------------------------------------

  const caption = () =>
    ["SIMULATED ULTRASOUND", document.getElementById("title").textContent, document.getElementById("image-caption").textContent,
      ...[...document.querySelectorAll("#image-values div")].map((one) => one.textContent)]
      .map((one) => one.trim()).filter(Boolean).join(" · ");

  // Draw the screens with banner, ruler and measurements into a canvas.
  async function compose(canvas = document.createElement("canvas")) {
    const box = document.getElementById("screens").getBoundingClientRect();
    const size = [2 * Math.ceil(box.width / 2), 2 * Math.ceil((box.height + BANNER) / 2)]; // videos have even sizes
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const context = canvas.getContext("2d", { alpha: false });
    context.fillStyle = "#000";
    context.fillRect(0, 0, ...size);
    context.fillStyle = "#e6e9eb";
    context.font = "13px sans-serif";
    context.fillText(caption(), 8, 17, size[0] - 16);
    for (const screen of document.querySelectorAll("[data-screen]")) {
      if (!screen.clientWidth) continue;
      const place = screen.getBoundingClientRect();
      const at = [place.left - box.left, place.top - box.top + BANNER, place.width, place.height];
      for (const layer of screen.querySelectorAll("canvas")) {
        if (!layer.clientWidth) continue;
        context.globalCompositeOperation = layer.classList.contains("difference") ? "difference" : "source-over";
        context.drawImage(layer, ...at);
      }
      context.globalCompositeOperation = "source-over";
      context.drawImage(await drawn(screen.querySelector("svg"), place), ...at);
      const corner = screen.dataset.screen === "simulated" ? "" : screen.querySelector(".ussim-corner").textContent;
      context.fillText(corner, at[0] + 8, at[1] + 16);
    }
    return canvas;
  }

  async function drawn(svg, { width, height }) {
    const copy = svg.cloneNode(true);
    for (const [name, value] of Object.entries({ xmlns: "http://www.w3.org/2000/svg", width, height })) copy.setAttribute(name, value);
    const image = new Image();
    image.src = `data:image/svg+xml,${encodeURIComponent(copy.outerHTML)}`;
    await image.decode();
    return image;
  }

  const blobOf = (canvas) => new Promise((done) => canvas.toBlob(done, "image/png"));

  async function savePicture() {
    window.ussim.download(await blobOf(await compose()), "ultrasound.png");
  }

  // Show the images of the cine one after the other; `each` is called with the index and seconds of each.
  async function throughCine(each) {
    const cine = document.getElementById("screens").dataset;
    const state = (name) => trame().state.get(cine[name]);
    const [first, last] = [state("cineFirst"), state("cineLast")];
    for (let n = first; n <= last; n += 1) {
      const before = window.ussim.images;
      await trame().trigger("cine_show", [n]);
      await window.ussim.until(() => window.ussim.images > before && state("cineIndex") === n);
      await each(n, state("cineSeconds"));
    }
  }

  async function saveVideo() {
    const canvas = await compose();
    const track = canvas.captureStream(0);
    const recorder = new MediaRecorder(track, { mimeType: "video/webm", videoBitsPerSecond: 12_000_000 });
    const parts = [];
    const stopped = new Promise((done) => (recorder.onstop = done));
    recorder.ondataavailable = ({ data }) => parts.push(data);
    recorder.start();
    let begun = null;
    await throughCine(async (_, seconds) => {
      begun ??= performance.now() - 1000 * seconds;
      await new Promise((done) => setTimeout(done, begun + 1000 * seconds - performance.now()));
      await compose(canvas);
      track.getVideoTracks()[0].requestFrame();
    });
    await new Promise((done) => setTimeout(done, 100)); // the last one is shown, too
    recorder.stop();
    await stopped;
    window.ussim.download(new Blob(parts, { type: "video/webm" }), "ultrasound.webm");
  }

  // The server writes the file; what it needs to know is where the image is in the picture, and its scale.
  async function saveDicom(isCine) {
    const form = new FormData();
    const { edges, scale } = screens.place("simulated");
    const box = document.getElementById("screens").getBoundingClientRect();
    const screen = document.querySelector("[data-screen=simulated]").getBoundingClientRect();
    const [left, top] = [screen.left - box.left, screen.top - box.top + BANNER];
    const within = (value, most) => Math.round(Math.min(Math.max(value, 0), most));
    const times = [];
    const add = async (n) => form.append("file", await blobOf(await compose()), `${n}.png`);
    if (isCine) {
      await throughCine(async (n, seconds) => {
        times.push(seconds);
        await add(n);
      });
    } else await add(0);
    const about = {
      x0: left + within(edges.left, screen.width), x1: left + within(edges.right, screen.width),
      y0: top + within(edges.top, screen.height), y1: top + within(edges.bottom, screen.height),
      mm_x: 1 / scale, mm_y: 1 / scale,
      frame_ms: times.length > 1 ? (1000 * (times[times.length - 1] - times[0])) / (times.length - 1) : 40,
    };
    form.append("about", JSON.stringify(about));
    await window.ussim.fetched("upload?for=dicom", { method: "POST", body: form });
  }

  window.addEventListener("pointerdown", clicked, { capture: true });
  window.addEventListener("pointermove", moved, { passive: true });
  window.ussimMeasure = { marks, words, tool, takeBack, unfrozen, dual, compose, savePicture, saveVideo, saveDicom, isDrawing: () => Boolean(drawing) };
})();
