// What a page asks the server that it came from: the scene, and of a run that trains, newer ones.
"use strict";

window.nsvqServer = {
  /** Seconds between two questions for a newer scene; 0 for none. */
  seconds: Number(document.currentScript.dataset.seconds),

  /** Bytes of the scene. */
  async bytes() {
    const answer = await fetch("scene.nsvq", { cache: "no-store" });
    if (!answer.ok) throw new Error(await answer.text());
    return new Uint8Array(await answer.arrayBuffer());
  },

  /** The version that the server has, once it is another one than that known; nothing is asked while nobody sees the page. */
  async newVersion(known, say) {
    for (;; await new Promise((resolve) => setTimeout(resolve, 1000 * this.seconds))) {
      if (document.hidden) continue;
      const answer = await fetch("version", { cache: "no-store" }).catch(() => null);
      const text = answer ? await answer.text() : "The server has ended; this is the last scene that it had.";
      if (!answer?.ok) say(text);
      else if (text !== known) return text;
    }
  },
};
