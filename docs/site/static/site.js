// Sphinx highlights search words also in the titles of the theme's icons, such as "Auto light/dark", which have no box.
SVGElement.prototype.getBBox ??= () => new DOMRect();

// On a phone, figures with small text keep a readable width and scroll sideways.
addEventListener("DOMContentLoaded", () => {
  for (const figure of document.querySelectorAll("img.sphx-glr-single-img, img[src*='study_']")) {
    const frame = document.createElement("div");
    frame.className = "figure-frame";
    figure.replaceWith(frame);
    frame.append(figure);
  }
});
