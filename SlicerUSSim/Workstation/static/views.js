// The arrangement of the views, as classes of the body (view_tools.py), and the mouse over the ultrasound image.
(() => {
  const EVERY_MS = 40; // more points than the line under the mouse can be read

  // "fold" all views, or "max" or "swap" one; once more undoes it.
  window.ussim.arrange = (kind, name) => {
    const body = document.body.classList;
    const wanted = kind === "fold" ? "ussim-folded" : `ussim-${kind}-${name}`;
    const is = body.contains(wanted);
    for (const other of [...body]) if (/^ussim-(folded$|max-|swap-)/.test(other)) body.remove(other);
    if (!is) body.add(wanted);
    for (const button of document.querySelectorAll("[id^='max-'], [id^='swap-'], #fold")) {
      button.setAttribute("aria-pressed", String(!is && button.id === (name ? `${kind}-${name}` : kind)));
    }
    window.dispatchEvent(new Event("resize"));
  };

  let told = 0;
  let waiting = 0;
  function point(at) {
    clearTimeout(waiting);
    const send = () => {
      told = performance.now();
      window.trame.trigger("point_at", at ?? [null, null]);
    };
    const rest = told + EVERY_MS - performance.now();
    if (rest <= 0) send();
    else waiting = setTimeout(send, rest);
  }

  let inside = false;
  let last = null;
  let again = 0;
  window.ussim.pointAgain = () => {
    clearTimeout(again);
    again = setTimeout(() => last && point(last), 150);
  };
  window.addEventListener(
    "pointermove",
    (event) => {
      const [was, where] = [inside, window.ussimScreens.at(event)];
      inside = Boolean(where?.isInside || event.target.closest?.(".ussim-view")); // views send their points themselves
      last = where?.isInside && where.isInMm ? where.mm : null;
      if (last) point(last);
      else if (was && !inside) point(null);
    },
    { passive: true },
  );
})();
