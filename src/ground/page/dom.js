// Elements in one line each.

export const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

function filled(e, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) if (value !== null && value !== undefined) e.setAttribute(key, value);
  e.append(...children.filter((child) => child !== null && child !== undefined));
  return e;
}

export const html = (tag, attributes = {}, ...children) => filled(document.createElement(tag), attributes, children);
export const svg = (tag, attributes = {}, ...children) => filled(document.createElementNS(SVG, tag), attributes, children);
