// Sphinx highlights search words also in the titles of the theme's icons, such as "Auto light/dark", which have no box.
SVGElement.prototype.getBBox ??= () => new DOMRect();
