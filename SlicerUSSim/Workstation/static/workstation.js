// Client side of the page: draws the images from streams.py, forwards keys, and measures the latency from a mouse event
// to the new image on the screen.
import "./screen.js";
import "./measure.js";

(() => {
  const client = Math.random().toString(36).slice(2);
  const measured = []; // milliseconds from an event to the image that shows its effect
  const STAMP_EVERY_MS = 40; // events in between share the stamp of the previous one, which overestimates their latency
  let stamped = 0;
  const shown = []; // times at which simulated images were displayed

  const workstation = { measured, shown, measuring: false, images: 0, image: null, uploading: 0, exporting: 0, connected: false };
  window.ussim = workstation;
  import("./views.js"); // which adds to it

  const screens = window.ussimScreens;
  const measure = window.ussimMeasure;
  const session = () => window.trame?.client?.getConnection?.()?.getSession?.();
  const canvasOf = (name) => document.querySelector(`canvas[data-stream="${name}"]`);
  const median = (values, share) => {
    const sorted = [...values].sort((a, b) => a - b);
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : NaN;
  };

  async function draw([{ name, meta, content }]) {
    if (meta?.number === undefined) return; // a view of Slicer, drawn by its own component
    const canvas = canvasOf(name);
    if (!canvas) return;
    const bitmap = meta.blank ? null : await createImageBitmap(new Blob([content], { type: meta.type }));
    if (Number(canvas.dataset.number ?? 0) > meta.number && meta.number > 1) return; // overtaken while it was decoded
    canvas.dataset.number = meta.number;
    if (name === "simulated") workstation.image = meta.blank ? null : meta;
    // One ruler: real images are on the pixels of the simulated one, unless their size is not known
    const ruler = meta.ruler?.x !== undefined ? meta.ruler : (workstation.image?.ruler ?? meta.ruler);
    if (name === "simulated" && !isFrozen()) measure.unfrozen(); // they belong to the previous image
    screens.put(name, bitmap, { ...meta, ruler });
    if (name !== "simulated" || !bitmap) return;
    workstation.images += 1;
    workstation.pointAgain?.(); // what is under a mouse that rests has changed
    requestAnimationFrame(() => {
      const now = performance.now();
      shown.push(now);
      if (shown.length > 4000) shown.splice(0, 2000);
      if (meta.stamp && meta.stamp[0] === client) {
        measured.push(now - meta.stamp[1]);
        if (measured.length > 4000) measured.splice(0, 2000);
      }
    });
  }

  workstation.summary = (count = 100) => {
    const last = measured.slice(-count);
    const times = shown.filter((time) => time > performance.now() - 2000);
    const rate = times.length > 1 ? (1000 * (times.length - 1)) / (times[times.length - 1] - times[0]) : 0;
    return { count: last.length, median: median(last, 0.5), p95: median(last, 0.95), rate };
  };

  function showLatency() {
    const place = document.getElementById("ussim-latency"); // exists while the user displays it
    workstation.measuring = Boolean(place);
    if (!place) return;
    const { count, median: middle, p95, rate } = workstation.summary();
    place.textContent = count
      ? `${rate.toFixed(0)} images/s · mouse to image ${middle.toFixed(0)} ms, 95 % within ${p95.toFixed(0)} ms (last ${count})`
      : "Move the probe with the mouse to measure latency";
  }

  // Whether a key belongs to the focused element: all of a field for text until Enter, those that change a slider (Space
  // does not: it freezes) or a choice.
  const NOT_TEXT = ["checkbox", "radio", "button", "submit", "file", "range"];
  const CHANGES = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End", "PageUp", "PageDown", " ", "Enter"];
  function isTaken(key, element) {
    if (!element?.closest) return false;
    const isText = element.tagName === "INPUT" && !NOT_TEXT.includes(element.type);
    if (isText || element.isContentEditable || element.tagName === "TEXTAREA") return true;
    const hasValue = element.closest("select, input[type=range], [role=slider], [role=menu], [role=listbox], [role=dialog]");
    return Boolean(hasValue) && CHANGES.includes(key) && !(key === " " && element.type === "range");
  }
  // After Enter, and a slider that was dragged, the next key is for the image.
  window.addEventListener("keydown", ({ key, target }) => {
    if (key === "Enter" && target.matches?.("input[type=number]")) target.blur();
  });
  window.addEventListener("pointerup", ({ target }) => {
    if (target.matches?.("input[type=range]")) target.blur();
  });

  // The time of a mouse event is sent to the server just before the event itself.
  window.addEventListener(
    "pointermove",
    (event) => {
      if (!workstation.measuring || !event.buttons || event.timeStamp - stamped < STAMP_EVERY_MS) return;
      stamped = event.timeStamp;
      window.trame.trigger("stamp", [client, stamped]);
    },
    { capture: true, passive: true },
  );
  const closeMenus = (except) => {
    for (const menu of document.querySelectorAll("details.ussim-menu[open]")) if (menu !== except) menu.open = false;
  };
  window.addEventListener("pointerdown", (event) => closeMenus(event.target.closest?.("details.ussim-menu")));
  const isFrozen = () => document.getElementById("image-status")?.textContent.trim() === "FROZEN";
  // Keys of the page itself, by what they do; the others move the probe.
  const OWN_KEYS = {
    " ": () => window.trame.trigger("freeze"),
    f: () => window.trame.trigger("freeze"),
    m: () => workstation.tool("distance"),
    t: () => workstation.tool("text"),
    c: () => window.trame.trigger("compare_next"),
    0: () => screens.fit(),
    Delete: () => measure.takeBack(),
    F1: () => workstation.help(),
    F2: () => workstation.toggle("drawer-open"),
  };
  window.addEventListener("keydown", (event) => {
    const question = document.getElementById("question");
    if (question) {
      if (event.key === "Escape") window.trame.trigger("answer", [Number(question.dataset.number), null]);
      return; // keys that move the probe are not for a question
    }
    if (event.ctrlKey || event.altKey || event.metaKey || isTaken(event.key, event.target)) return;
    if (document.getElementById("help").open) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key === "Escape") closeMenus();
    if (key === "Escape" && measure.isDrawing()) {
      measure.takeBack();
      return;
    }
    if (OWN_KEYS[key]) {
      event.preventDefault();
      OWN_KEYS[key]();
      return;
    }
    const keys = canvasOf("simulated")?.dataset.keys.split(" ") ?? [];
    if (!keys.includes(key)) return;
    event.preventDefault();
    if (isFrozen() && ["ArrowLeft", "ArrowRight"].includes(key)) window.trame.trigger("cine_step", [key === "ArrowLeft" ? -1 : 1]);
    else window.trame.trigger("key", [key, event.shiftKey]);
  });

  // ---- mouse on the image ---------------------------------------------------------------------------------------

  window.addEventListener(
    "wheel",
    (event) => {
      if (!screens.at(event)) return;
      event.preventDefault();
      if (event.ctrlKey || !isFrozen()) screens.zoomAt(event, event.deltaY < 0 ? 1.15 : 1 / 1.15);
      else window.trame.trigger("cine_step", [event.deltaY < 0 ? -1 : 1]);
    },
    { passive: false },
  );
  window.addEventListener("pointermove", (event) => {
    if (event.buttons === 4 && screens.at(event)) screens.move(event.movementX, event.movementY);
  });
  window.addEventListener("dblclick", (event) => {
    const where = screens.at(event);
    const ruler = workstation.image?.ruler;
    if (!where?.isInside || where.screen !== "simulated" || measure.isDrawing()) return;
    window.trame.trigger("aim_image", [(where.mm[0] - ruler.x) / ruler.w, (where.mm[1] - ruler.y) / ruler.h]);
  });

  // ---- what buttons of the page do ------------------------------------------------------------------------------

  workstation.toggle = (name) => document.getElementById("page").classList.toggle(name);
  workstation.help = () => document.getElementById("help").showModal();
  workstation.flip = (axis) => screens.flip(axis);
  workstation.fitView = () => screens.fit();
  workstation.until = async (condition) => {
    while (!condition()) await new Promise((done) => setTimeout(done, 15));
  };
  for (const name of ["tool", "dual", "savePicture", "saveVideo", "saveDicom"]) {
    workstation[name] = async (...options) => {
      workstation.exporting += 1;
      try {
        closeMenus();
        await measure[name](...options);
      } finally {
        workstation.exporting -= 1;
      }
    };
  }
  let before = null; // the eight gains when the master began to move
  workstation.tgcMaster = (slider) => {
    const names = slider.dataset.names.split(",");
    if (!before) {
      before = names.map((name) => Number(document.getElementById(`tgc-${name}`).value));
      slider.addEventListener("change", () => (before = null), { once: true });
    }
    names.forEach((name, n) => {
      const { min, max } = document.getElementById(`tgc-${name}`);
      window.trame.trigger("set", [name, Math.min(Math.max(before[n] + Number(slider.value), Number(min)), Number(max))]);
    });
  };

  // Sends the files of an input; the bar below the image shows how far they are.
  workstation.send = (input, purpose) => {
    const files = [...input.files].map((file) => [file.webkitRelativePath || file.name, file]);
    sendFiles(files, purpose);
    input.value = ""; // so that the same file can be chosen again
  };

  // `files` are [path, file]; the folders above a file become part of its name, since a name is not a path.
  function sendFiles(files, purpose) {
    if (!files.length) return;
    const form = new FormData();
    for (const [path, file] of files) form.append("file", file, path.split("/").slice(-3).join("_"));
    const names = files.length > 4 ? `${files.length} files` : files.map(([, file]) => file.name).join(", ");
    const bar = document.getElementById("upload");
    const request = new XMLHttpRequest();
    const tell = (percent) => (document.getElementById("upload-text").textContent = `Send ${names} ${percent} %`);
    workstation.uploading += 1;
    tell(0);
    bar.hidden = false;
    document.getElementById("upload-cancel").onclick = () => request.abort();
    request.upload.onprogress = ({ loaded, total }) => tell(Math.floor((100 * loaded) / Math.max(total, 1)));
    request.onloadend = () => {
      workstation.uploading -= 1;
      bar.hidden = workstation.uploading === 0;
    };
    request.open("POST", `upload?${new URLSearchParams(purpose)}`);
    request.send(form);
  }

  // ---- files and folders that are dropped on the page -----------------------------------------------------------

  const hasFiles = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");

  // [path, file] of all files in a folder, or of one file.
  async function filesOf(entry, path) {
    if (entry.isFile) return [[path + entry.name, await new Promise((done, failed) => entry.file(done, failed))]];
    const reader = entry.createReader();
    const found = [];
    for (;;) {
      const some = await new Promise((done, failed) => reader.readEntries(done, failed)); // a hundred at once
      if (!some.length) return found;
      for (const inside of some) found.push(...(await filesOf(inside, `${path}${entry.name}/`)));
    }
  }

  window.addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    document.body.classList.add("ussim-dropping");
  });
  window.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("ussim-dropping");
  });
  window.addEventListener("drop", async (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    document.body.classList.remove("ussim-dropping");
    // What was dropped can be asked for only before the first wait
    const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
    const plain = entries.length ? [] : [...event.dataTransfer.files].map((file) => [file.name, file]);
    const found = await Promise.all(entries.map((entry) => filesOf(entry, "")));
    sendFiles([...plain, ...found.flat()], { for: "open" });
  });

  // Over HTTP: on the web socket keys and Cancel would wait until the file is there.
  workstation.save = (kind) => workstation.fetched(`exported?${new URLSearchParams({ kind })}`, { cache: "no-store" });
  workstation.fetched = async (address, options) => {
    closeMenus();
    workstation.exporting += 1;
    try {
      const answer = await fetch(address, options);
      if (answer.status !== 200) return; // the server shows the error, or it was cancelled
      const name = decodeURIComponent(answer.headers.get("Content-Disposition").split("''")[1]);
      workstation.download(await answer.blob(), name);
    } finally {
      workstation.exporting -= 1;
    }
  };
  workstation.download = (blob, name) => {
    const link = document.createElement("a");
    const { patient = "", time = "" } = workstation.image ?? {};
    const whose = `${patient.split(".")[0]}-${time.slice(0, 19).replaceAll(/[-:]/g, "")}`.replaceAll(/[^\w-]+/g, "-");
    link.download = name.replace(/^ultrasound/, whose);
    link.href = URL.createObjectURL(blob);
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000); // the browser saves it in its own time
  };

  // For screen readers, what trame's own parts lack: names of the rendered views, and leave to zoom.
  function nameViews() {
    for (const image of document.querySelectorAll("img.image-display-area:not([alt])")) image.alt = "View of the anatomy";
    const viewport = document.querySelector("meta[name=viewport]");
    if (viewport?.content.includes("maximum-scale")) viewport.content = "width=device-width, initial-scale=1";
  }

  // A new server has a new token, so that its address is to be opened.
  function lost() {
    if (document.getElementById("connection-lost")) return;
    const note = document.createElement("div");
    note.id = "connection-lost";
    note.setAttribute("role", "alert");
    note.textContent = "The connection to the server is lost. Start ussim serve again, and open the address that it prints.";
    document.body.append(note);
  }

  function connect() {
    const connection = session();
    if (!connection || !window.trame?.state || !canvasOf("simulated")) {
      setTimeout(connect, 50);
      return;
    }
    window.trame.client.onConnectionClose(lost);
    window.trame.client.onConnectionError(lost);
    connection.subscribe("trame.rca.topic.stream", draw);
    screens.observe();
    workstation.connected = true;
    window.trame.trigger("page_opened");
    setInterval(showLatency, 300);
    setInterval(nameViews, 1000);
  }
  connect();
})();
