// What the page does when the server is gone: it says so, waits for it, and loads itself again once it is back.
//
// The browser sends the cookie with the token to whatever answers at this address. On a computer with other users that
// could be a program of theirs, so the page first asks, without the cookie, for an answer that only the server with this
// token has (access.proof).
(() => {
  const EVERY_MS = 1000;
  let key = null; // CryptoKey, imported while the server is there: later only what is known here can be trusted
  let isLost = false;

  const bytes = (hex) => new Uint8Array(hex.match(/../g).map((pair) => parseInt(pair, 16)));
  const hex = (buffer) => [...new Uint8Array(buffer)].map((byte) => byte.toString(16).padStart(2, "0")).join("");

  // There is no crypto.subtle over plain http from another computer, where everybody on the way reads the token anyway.
  async function remember() {
    const text = document.getElementById("proof-key")?.dataset.key;
    if (!text || !window.crypto?.subtle) return;
    key = await crypto.subtle.importKey("raw", bytes(text), { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  }

  // "back", "other": another server answers, or none.
  async function asked() {
    const nonce = hex(crypto.getRandomValues(new Uint8Array(16)));
    try {
      const answer = await fetch(`alive?nonce=${nonce}`, { credentials: "omit", cache: "no-store" });
      if (!answer.ok) return "other";
      const text = (await answer.text()).trim();
      if (!key) return "back";
      return text === hex(await crypto.subtle.sign("HMAC", key, new TextEncoder().encode(nonce))) ? "back" : "other";
    } catch {
      return "none";
    }
  }

  function lost() {
    if (isLost) return;
    isLost = true;
    const note = document.createElement("div");
    note.id = "connection-lost";
    note.setAttribute("role", "alert");
    document.body.append(note);
    const say = (text) => {
      if (note.textContent !== text) note.textContent = text;
    };
    say("The connection to the server is lost. The page waits for it.");
    const ask = async () => {
      const found = await asked();
      if (found === "back") {
        window.location.reload();
        return;
      }
      if (found === "other") say("A new server answers here. Open the address that ussim serve has printed.");
      setTimeout(ask, EVERY_MS);
    };
    ask();
  }

  function begin() {
    const client = window.trame?.client;
    if (!client?.getConnection?.() || !window.ussim?.connected) {
      setTimeout(begin, 100);
      return;
    }
    client.onConnectionClose(lost);
    client.onConnectionError(lost);
    remember();
  }
  begin();
})();
