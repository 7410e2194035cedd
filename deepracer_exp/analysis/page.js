// Draws the figures of a page from what it holds, each when it comes into sight.
"use strict";
(() => {
  const unpack = (id) => {
    const packed = atob(document.getElementById(id).textContent);
    const bytes = Uint8Array.from(packed, (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };
  let library;
  const plotly = () => {
    library ??= unpack("plotly").then((source) => {
      const script = document.createElement("script");
      script.textContent = source;
      document.head.append(script);
      return window.Plotly;
    });
    return library;
  };
  const draw = async (box) => {
    if (box.dataset.state) return;
    box.dataset.state = "drawing";
    try {
      const { data, layout } = JSON.parse(await unpack(`data-${box.dataset.plot}`));
      await (await plotly()).newPlot(box, data, layout, {
        displaylogo: false,
        // Its button would upload what is drawn.
        showSendToCloud: false,
        plotlyServerURL: "",
        responsive: true,
        toImageButtonOptions: { filename: box.dataset.plot, scale: 2 },
      });
      box.dataset.state = "drawn";
    } catch (error) {
      box.dataset.state = "failed";
      box.textContent = `This figure could not be drawn: ${error}`;
      throw error;
    }
  };
  const boxes = document.querySelectorAll("[data-plot]");
  if (window.DecompressionStream) {
    const watcher = new IntersectionObserver(
      (entries) => entries.filter((one) => one.isIntersecting).forEach((one) => draw(one.target)),
      { rootMargin: "600px" },
    );
    boxes.forEach((box) => watcher.observe(box));
    window.addEventListener("beforeprint", () => boxes.forEach(draw));
  } else {
    boxes.forEach((box) => { box.textContent = "Figures need a browser of 2023 or later."; });
  }
  document.querySelectorAll("[data-copies]").forEach((button) => {
    button.addEventListener("click", () => {
      navigator.clipboard.writeText(document.getElementById(button.dataset.copies).textContent);
    });
  });
})();
