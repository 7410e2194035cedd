// Drives two laps beside each other: each car, and its point on each curve, stands where it was at the slider's time.
"use strict";
(() => {
  // Metres between two control steps that no car drives: it was put back onto the track.
  const JUMP_M = 0.5;
  const CAR_M = 0.35;  // length of a car on the map
  const slider = document.querySelector("#time"), button = document.querySelector("#play");
  const clock = document.querySelector("#clock"), rate = document.querySelector("#rate");
  const box = document.querySelector("[data-plot]"), rows = [...document.querySelectorAll("tr[data-lap]")];
  const laps = JSON.parse(slider.dataset.laps), end = Number(slider.max);

  let playing = false, time = 0, before = 0;  // seconds of the laps; when the last frame was shown

  // The values of a lap where `key` has reached `value`, between its steps.
  const state = (lap, key, value) => {
    const last = lap.time_s.length - 1;
    const next = lap[key].findIndex((one) => one > value);
    const after = next < 0 ? last : next, before = Math.max(after - 1, 0);
    const span = lap[key][after] - lap[key][before];
    let part = span > 0 ? Math.min(Math.max((value - lap[key][before]) / span, 0), 1) : 0;
    if (Math.hypot(lap.x[after] - lap.x[before], lap.y[after] - lap.y[before]) > JUMP_M) part = Math.floor(part);
    const found = {};
    for (const name in lap) found[name] = lap[name][before] + part * (lap[name][after] - lap[name][before]);
    found.place = 100 * (found.driven - Math.floor(found.driven));
    return found;
  };
  // Seconds that a lap came later to where it is than the other one; only from the same start can they be compared.
  const behind = (now, lap, other) => {
    if (Math.abs(lap.driven[0] - other.driven[0]) > 0.02 || now.driven >= Math.max(...other.driven)) return "";
    const seconds = now.time_s - state(other, "driven", now.driven).time_s;
    return seconds > 0.005 ? seconds.toFixed(2) : "";
  };

  const text = (value, digits) => (Number(value.toFixed(digits)) + 0).toFixed(digits);  // without -0.0
  const show = () => {
    const now = laps.map((lap) => state(lap, "time_s", time));
    clock.textContent = `${time.toFixed(2)} s`;
    rows.forEach((row, at) => {
      const { place, speed, steering } = now[at];
      const texts = [text(place, 1), text(speed, 2), text(steering, 1), behind(now[at], laps[at], laps[1 - at])];
      texts.forEach((text, column) => { row.cells[column + 1].textContent = text; });
    });
    if (box.dataset.state !== "drawn") return;
    const moved = box.data.map((trace, at) => at).filter((at) => box.data[at].meta);
    const data = moved.map((at) => {
      const { lap, x, y } = box.data[at].meta, one = now[lap], yaw_rad = one.yaw_deg * Math.PI / 180;
      const back = [Math.cos(yaw_rad), Math.sin(yaw_rad)].map((part) => -CAR_M * part);
      return x === "x" ? { x: [one.x + back[0], one.x], y: [one.y + back[1], one.y] } : { x: [one[x]], y: [one[y]] };
    });
    // Without drawing all the rest again, which takes five times as long.
    Plotly.animate(box, { data, traces: moved }, { mode: "immediate", frame: { duration: 0, redraw: false }, transition: { duration: 0 } });
  };

  const play = (on) => {
    playing = on;
    button.textContent = on ? "Pause" : "Play";
    if (!on) return;
    if (time >= end) time = 0;
    before = performance.now();
    requestAnimationFrame(frame);
  };
  const frame = (now) => {
    if (!playing) return;
    time = Math.min(time + Math.max(now - before, 0) * Number(rate.value) / 1000, end);
    before = now;
    slider.value = time;
    show();
    if (time >= end) play(false);
    else requestAnimationFrame(frame);
  };
  button.addEventListener("click", () => play(!playing));
  slider.addEventListener("input", () => { play(false); time = Number(slider.value); show(); });
  box.addEventListener("drawn", show);
  show();
})();
