// The search of the site runs in a worker, which browsers refuse to pages opened from files. There
// this runs it in a hidden frame: the plugin `offline` would load such a script from another server.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      const scope = frame.contentWindow;
      this.started = new Promise((resolve) => {
        // To the page, as from a worker.
        scope.postMessage = (data) => {
          const event = new MessageEvent("message", { data });
          this.dispatchEvent(event);
          if (this.onmessage) this.onmessage(event);
        };
        const load = (source) =>
          new Promise((loaded) => {
            const script = scope.document.createElement("script");
            script.src = source;
            script.onload = loaded;
            scope.document.head.appendChild(script);
          });
        // Asynchronous, unlike in a worker: the search awaits it.
        scope.importScripts = (...sources) => Promise.all(sources.map(load));
        load(new URL(url, location.href).href).then(resolve);
      });
      this.scope = scope;
      this.frame = frame;
    }

    postMessage(data) {
      this.started.then(() => {
        this.scope.dispatchEvent(new this.scope.MessageEvent("message", { data }));
      });
    }

    terminate() {
      this.frame.remove();
    }
  };
}
