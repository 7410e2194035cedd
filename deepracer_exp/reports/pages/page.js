// Draws the figures of a page from what it holds, each when it comes into sight and all before printing.
"use strict";
(() => {
  // Pixels: on less, panels stand below each other; as wide as A4 and Letter at the zoom of printed figures.
  const NARROW = 600, SHEET = 900;
  const boxes = [...document.querySelectorAll("[data-plot]")];
  const night = matchMedia("(prefers-color-scheme: dark)");
  const packed = (id) => document.getElementById(id).textContent;
  const unpack = (id) => {
    const bytes = Uint8Array.from(atob(packed(id)), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };

  const texts = {}, dark = JSON.parse(packed("dark"));
  const draw = (box, sheet) => {
    const width = sheet ? (box.closest(".first") ? NARROW - 1 : SHEET) : box.clientWidth, text = texts[box.dataset.plot];
    if (!window.Plotly || !text || !width) return;
    const colored = night.matches && !sheet
      ? text.replace(/"(#\w{6}|rgba\([\d,.]+\))"/g, (one, color) => `"${dark[color.toLowerCase()] ?? color}"`) : text;
    try {
      const { data, layout, narrow } = JSON.parse(colored);
      if (width < NARROW) Object.assign(layout, narrow);
      box.style.height = `${layout.height}px`;
      Plotly.react(box, data, { ...layout, width }, {
        displaylogo: false,
        displayModeBar: !sheet && width >= NARROW,
        // Its button would upload what is drawn.
        showSendToCloud: false,
        plotlyServerURL: "",
        toImageButtonOptions: { filename: box.dataset.plot, scale: 2 },
      });
      box.dataset.state = "drawn";
      box.dispatchEvent(new Event("drawn"));
    } catch (error) {
      box.dataset.state = "failed";
      box.textContent = `This figure could not be drawn: ${error}`;
      throw error;
    }
  };
  // A folded figure has no width: it is drawn when it comes into sight.
  const again = () => boxes.filter((box) => box.dataset.state === "drawn").forEach((box) => {
    if (box.checkVisibility()) draw(box);
    else delete box.dataset.state;
  });
  const watch = () => {
    const inSight = new IntersectionObserver(
      (entries) => entries.filter((one) => one.isIntersecting).forEach((one) => one.target.dataset.state || draw(one.target)),
      { rootMargin: "600px" },
    );
    const resized = new ResizeObserver((entries) => entries.map((one) => one.target).forEach((box) => {
      if (box.dataset.state === "drawn" && box.clientWidth && box.clientWidth !== box.layout.width) draw(box);
    }));
    boxes.forEach((box) => { inSight.observe(box); resized.observe(box); });
    night.addEventListener("change", again);
  };
  if (boxes.length && window.DecompressionStream) {
    // While a frame is being written the page counts as loading: what prints or photographs it then waits.
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.append(frame);
    frame.contentDocument.open();
    const names = [...new Set(boxes.map((box) => box.dataset.plot))];
    Promise.all([unpack("plotly"), ...names.map(async (name) => { texts[name] = await unpack(`data-${name}`); })])
      .then(([source]) => {
        const script = document.createElement("script");
        script.textContent = source;
        document.head.append(script);
        boxes.filter((box) => box.checkVisibility() && box.getBoundingClientRect().top < innerHeight)
          .forEach((box) => draw(box));
        watch();
      })
      .finally(() => { frame.contentDocument.close(); frame.remove(); });
  } else {
    boxes.forEach((box) => { box.textContent = "Figures need a browser of 2023 or later."; });
  }

  const parts = [...document.querySelectorAll("main details")];
  let folded = [];
  window.addEventListener("beforeprint", () => {
    folded = parts.filter((part) => !part.open);
    folded.forEach((part) => { part.open = true; });
    boxes.forEach((box) => draw(box, true));
  });
  window.addEventListener("afterprint", () => {
    folded.forEach((part) => { part.open = false; });
    again();
  });
  // What was folded stays so when the page is loaded again.
  (history.state?.open ?? []).forEach((open, at) => { if (parts[at]) parts[at].open = open; });
  parts.forEach((part) => part.addEventListener("toggle", () => {
    history.replaceState({ open: parts.map((one) => one.open) }, "");
  }));

  // A link leads into what is folded, too.
  const unfoldAround = (hash) => {
    for (let one = document.getElementById(hash.slice(1)); one; one = one.parentElement) {
      if (one.localName === "details") one.open = true;
    }
  };
  unfoldAround(location.hash);
  document.addEventListener("click", (event) => {
    const link = event.target.closest('a[href^="#"]');
    if (link) unfoldAround(link.hash);
  });

  const contents = document.querySelector(".contents > details"), desk = matchMedia("(min-width: 1081px)");
  const unfold = () => { contents.open = desk.matches; };
  unfold();
  desk.addEventListener("change", unfold);
  contents.addEventListener("click", (event) => { if (event.target.closest("a")) unfold(); });

  // A page that is served while its contents change has a version.
  const version = document.querySelector("meta[name=version]")?.content;
  if (version) setInterval(async () => {
    const now = await fetch("version").then((answer) => answer.text(), () => version);
    if (now !== version) location.reload();
  }, 1000);

  document.querySelectorAll(".command").forEach((box) => {
    const button = document.createElement("button");
    button.textContent = "Copy";
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(box.firstElementChild.textContent);
        button.textContent = "Copied";
      } catch {
        getSelection().selectAllChildren(box.firstElementChild);
        button.textContent = "Selected";
      }
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
    });
    box.append(button);
  });
})();
