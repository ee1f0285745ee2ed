// Clouds of one instant; the data are in the element `data`, see instant.py.
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { clouds } = data;
  const draw = startPlayer(data, (number) =>
    number < clouds.length ? unpackCloud(clouds[number]) : null, () => clouds.length - 1);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  document.documentElement.dataset.drawn = Math.round(performance.now());
})();
