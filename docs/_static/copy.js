"use strict";
// A button on each block of code that copies what one would type: without prompts, and without the output of a prompt.
document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll("div.cell_input div.highlight, div.highlight-sh div.highlight, div.highlight-python div.highlight, div.doctest div.highlight").forEach((block) => {
    const button = document.createElement("button");
    button.className = "copy";
    button.type = "button";
    button.textContent = "copy";
    button.setAttribute("aria-label", "Copy the code");
    button.addEventListener("click", () => {
      const text = block.querySelector("pre").textContent.replace(/\n$/, "");
      const typed = text.startsWith(">>> ")
        ? text.split("\n").filter((line) => /^(>>>|\.\.\.)( |$)/.test(line)).map((line) => line.slice(4)).join("\n")
        : text;
      const done = () => {
        button.textContent = "copied";
        setTimeout(() => { button.textContent = "copy"; }, 1500);
      };
      if (navigator.clipboard) {
        navigator.clipboard.writeText(typed).then(done);
      } else { // a page opened over plain http
        const area = document.body.appendChild(document.createElement("textarea"));
        area.value = typed;
        area.select();
        document.execCommand("copy");
        area.remove();
        done();
      }
    });
    block.appendChild(button);
  });
});
