// Scans from the server that gave the page, see view_server.py.
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  // Number of scans: all if known, else those expected, or loaded.
  let total = data.total, loaded = 0;

  // A response: bytes of the header (32 bits, little-endian), the header as JSON, deflated points.
  async function load(number) {
    if (total !== null && number >= total) return null;
    let bytes;
    try {
      bytes = new Uint8Array(await (await fetch("scans/" + number)).arrayBuffer());
    } catch {
      throw new Error("mlbatch view has ended; start it again, and reload this page.");
    }
    const size = new DataView(bytes.buffer).getUint32(0, true);
    const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size)));
    if (head.error) throw new Error(head.error);
    if (head.total !== undefined) { total = head.total; return null; }
    loaded = Math.max(loaded, number + 1);
    return unpackCloud({ ...head, data: bytes.subarray(4 + size) });
  }

  const { draw } = startPlayer(data, load, () => Math.max(total || data.expected, loaded) - 1);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  document.documentElement.dataset.drawn = Math.round(performance.now());
})();
