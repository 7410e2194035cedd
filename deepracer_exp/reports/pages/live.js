// Lets the clock of a training run on while its page is not loaded again.
"use strict";
(() => {
  const clock = document.querySelector(".clock");
  if (!clock) return;
  const two = (number) => String(number).padStart(2, "0");
  const text = (ms) => {
    const seconds = Math.max(0, Math.round(ms / 1000)), hours = Math.floor(seconds / 3600);
    const minutes = Math.floor(seconds / 60) % 60;
    return hours ? `${hours}:${two(minutes)}:${two(seconds % 60)}` : `${minutes}:${two(seconds % 60)}`;
  };
  const { elapsed, since, until } = clock.dataset, left = clock.querySelector(".left");
  const tick = () => {
    clock.querySelector(".elapsed").textContent = text(since ? Date.now() - Number(since) : Number(elapsed));
    if (left) left.textContent = text(Number(until) - Date.now());
  };
  tick();
  if (since) setInterval(tick, 1000);
})();
