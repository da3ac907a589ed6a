"use strict";
{
  const films = [...document.querySelectorAll("[data-film]")];
  const choices = [...document.querySelectorAll("[data-play]")];
  const controls = document.getElementById("reel");
  // Frames per second.
  const SPEED = 10;
  let film = 0;
  let timer = 0;

  const frames = () => films[film].dataset.frames.split(" ");
  const values = () => films[film].dataset.psnr.split(" ");

  const show = (at) => {
    const time = controls.querySelector("input");
    time.max = frames().length - 1;
    time.value = at;
    films.forEach((of, k) => of.classList.toggle("active", k === film));
    choices.forEach((button, k) => button.setAttribute("aria-pressed", k === film));
    for (const pile of films[film].querySelectorAll(".pile")) {
      [...pile.children].forEach((image, k) => image.classList.toggle("now", k === at));
    }
    const words = `frame ${frames()[at]}: PSNR ${values()[at]} dB`;
    time.setAttribute("aria-valuetext", words);
    controls.querySelector("output").textContent = words;
  };

  const stop = () => {
    clearInterval(timer);
    timer = 0;
    controls.querySelector("#play").textContent = "Play";
  };

  const toggle = () => {
    if (timer) return stop();
    controls.querySelector("#play").textContent = "Pause";
    timer = setInterval(() => {
      const at = controls.querySelector("input").valueAsNumber;
      show((at + 1) % frames().length);
    }, 1000 / SPEED);
  };

  if (controls) {
    controls.hidden = false;
    const time = controls.querySelector("input");
    controls.querySelector("#play").addEventListener("click", toggle);
    time.addEventListener("input", () => {
      stop();
      show(time.valueAsNumber);
    });
    time.addEventListener("keydown", (event) => {
      if (event.key !== " ") return;
      event.preventDefault();
      toggle();
    });
    choices.forEach((button, k) =>
      button.addEventListener("click", () => {
        film = k;
        show(Math.min(time.valueAsNumber, frames().length - 1));
      }),
    );
    show(0);
  }
}
