"use strict";
{
  const stage = document.getElementById("stage");
  const range = document.getElementById("cut");
  const buttons = [...document.querySelectorAll("[data-show]")];
  const pictures = [...document.querySelectorAll("[data-picture]")];
  const sides = [...document.querySelectorAll("[data-side]")];

  const cut = (percent) => {
    const value = Math.min(100, Math.max(0, percent));
    range.value = value;
    stage.style.setProperty("--cut", value + "%");
  };

  const show = (number) => {
    pictures.forEach((picture, i) => picture.classList.toggle("active", i === number));
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", i === number));
    document.getElementById("caption").textContent = pictures[number].querySelector(".caption").textContent;
  };

  const choose = ({ dataset: { side }, value }) => {
    for (const image of document.querySelectorAll(".picture img")) {
      image.classList.toggle(side, image.dataset.kind === value);
    }
    stage.querySelector(".tag-" + side).textContent = value;
  };

  const follow = (event) => {
    const box = stage.getBoundingClientRect();
    cut((100 * (event.clientX - box.left)) / box.width);
  };

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    follow(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (stage.hasPointerCapture(event.pointerId)) follow(event);
  });
  range.addEventListener("input", () => cut(range.valueAsNumber));
  buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
  sides.forEach((side) => side.addEventListener("change", () => choose(side)));

  // A browser that goes back restores what was chosen.
  sides.forEach(choose);
  cut(range.valueAsNumber);
  if (pictures.length > 0) show(0);
}
