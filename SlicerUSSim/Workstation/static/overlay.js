// Ruler, marks and caption of an image, drawn together with it from the message that brings it.
(() => {
  const INK = "#b9c2c9";

  function add(parent, name, attributes = {}, text = "") {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.textContent = text;
    parent.append(element);
    return element;
  }

  function depthRuler(svg, us) {
    const group = add(svg, "g", {
      id: "depth-ruler", transform: `translate(${us.x + us.w + us.size} 0)`, stroke: INK, "stroke-width": us.size / 12,
    });
    add(group, "line", { y1: 0, y2: us.y + us.h });
    for (const { y, text } of us.ticks) {
      const tick = add(group, "g", { transform: `translate(0 ${y})` });
      add(tick, "line", { x2: (text ? 0.9 : 0.45) * us.size });
      if (text) add(tick, "text", { x: 1.2 * us.size, y: 0.35 * us.size, "font-size": us.size, stroke: "none" }, text);
    }
    if (us.focus > us.y + us.h) return; // below the image, where other things are
    const shape = `M 0 ${us.focus} l ${-0.9 * us.size} ${-0.5 * us.size} v ${us.size} z`;
    const focus = add(group, "path", { id: "focus-mark", d: shape, fill: "#ffc83d", stroke: "none" });
    add(focus, "title", {}, "Transmit focus");
  }

  function greyBar(svg, us) {
    const bar = add(svg, "g", { id: "grey-bar", transform: `translate(${us.x - 2.6 * us.size} ${us.y})` });
    const greys = add(add(bar, "defs"), "linearGradient", { id: "ussim-greys", x1: 0, x2: 0, y1: 0, y2: 1 });
    add(greys, "stop", { offset: 0, "stop-color": "#fff" });
    add(greys, "stop", { offset: 1, "stop-color": "#000" });
    add(bar, "rect", {
      width: 0.8 * us.size, height: 0.3 * us.h, fill: "url(#ussim-greys)", stroke: "#555", "stroke-width": us.size / 15,
    });
    add(bar, "text", { y: -0.3 * us.size, "font-size": 0.8 * us.size }, "0 dB");
    add(bar, "text", { y: 0.3 * us.h + us.size, "font-size": 0.8 * us.size }, `−${us.range}`);
  }

  const LEAST_PX = 11; // of letters, however small the image is

  let drawn = null; // the last ruler, drawn anew for another size on the screen

  // Draws what belongs to an image; without a ruler there is none.
  window.ussimOverlay = (svg, ruler) => {
    drawn = ruler;
    svg.replaceChildren();
    if (!ruler) return;
    if (!svg.dataset.observed) {
      svg.dataset.observed = "1";
      new ResizeObserver(() => window.ussimOverlay(svg, drawn)).observe(svg);
    }
    const shownPx = svg.clientHeight || 1;
    const us = { ...ruler, size: Math.max(ruler.size, (LEAST_PX * ruler.h) / shownPx) };
    svg.setAttribute("viewBox", `${us.x} ${us.y} ${us.w} ${us.h}`);
    add(svg, "rect", { x: us.x, y: us.y, width: us.w, height: us.h, fill: "transparent" });
    const side = { id: "orientation-mark", transform: `translate(${us.x + 1.2 * us.size} ${us.y + 1.2 * us.size})` };
    const mark = add(svg, "g", side);
    add(mark, "title", {}, "Side of the probe's ridge");
    add(mark, "circle", { r: 0.8 * us.size, fill: "#ff9d2e" });
    depthRuler(svg, us);
    greyBar(svg, us);
  };
})();
