"use strict";
for (const root of document.querySelectorAll(".slider")) {
  const stage = root.querySelector(".stage");
  const range = root.querySelector(".cut");
  const images = [...stage.querySelectorAll("img")];
  const sides = [...root.querySelectorAll("[data-side]")];
  const caption = root.querySelector(".caption");
  const size = caption.textContent.split(";")[1] ?? "";

  const cut = (percent) => {
    const value = Math.min(100, Math.max(0, percent));
    range.value = value;
    stage.style.setProperty("--cut", value + "%");
  };

  const choose = ({ dataset: { side }, value }) => {
    images.forEach((image) => image.classList.toggle(side, image.dataset.layer === value));
    const notes = sides.map((own) => images[own.value]).filter((image) => image.dataset.note);
    const several = notes.length > 1;
    caption.textContent =
      notes.map((image) => (several ? image.alt + ": " : "") + image.dataset.note).join("; ") + (size && ";" + size);
  };

  const follow = (event) => {
    const box = images[0].getBoundingClientRect();
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
  sides.forEach((side) => side.addEventListener("change", () => choose(side)));

  // When a user goes back to this page, the browser restores the former choices and position: apply them.
  sides.forEach(choose);
  cut(range.valueAsNumber);
}
