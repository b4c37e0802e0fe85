"use strict";
// Numbers from samples: plain functions, without the page.

// The index of the sample whose time is nearest; times rise.
function nearestIndex(times, t) {
  let low = 0, high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle; else high = middle;
  }
  return Math.abs(times[low] - t) <= Math.abs(times[high] - t) ? low : high;
}

// Of the samples from index `first` to `last`, both included; NaN is left out.
function measure(values, first, last) {
  let low = Infinity, high = -Infinity, sum = 0, squares = 0, count = 0;
  for (let at = first; at <= last; at++) {
    const value = values[at];
    if (Number.isNaN(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
    sum += value;
    squares += value * value;
    count++;
  }
  if (!count) return null;
  return { low, high, peakToPeak: high - low, mean: sum / count, rms: Math.sqrt(squares / count) };
}

// Samples on a grid of equal times, by straight lines over ticks that are missing.
function onGrid(ticks, values) {
  const grid = new Float64Array(ticks[ticks.length - 1] - ticks[0] + 1);
  for (let at = 0; at < ticks.length; at++) {
    const to = ticks[at] - ticks[0];
    const from = at ? ticks[at - 1] - ticks[0] : 0;
    const before = at ? values[at - 1] : values[0];
    for (let k = from + 1; k < to; k++) grid[k] = before + (values[at] - before) * (k - from) / (to - from);
    grid[to] = values[at];
  }
  return grid;
}

// In place, radix 2; the length is a power of two.
function transform(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let size = 2; size <= n; size *= 2) {
    const half = size / 2;
    for (let k = 0; k < half; k++) {
      const c = Math.cos(2 * Math.PI * k / size), s = -Math.sin(2 * Math.PI * k / size);
      for (let a = k; a < n; a += size) {
        const b = a + half;
        const x = re[b] * c - im[b] * s, y = re[b] * s + im[b] * c;
        re[b] = re[a] - x; im[b] = im[a] - y;
        re[a] += x; im[a] += y;
      }
    }
  }
}

// Amplitude over frequency: mean removed, Hann window, padded with zeros to a power of two.
// A sine of amplitude a that lies on a line of the spectrum is shown as a.
function spectrum(samples, rateHz) {
  const n = samples.length;
  if (n < 8 || samples.some(Number.isNaN)) return null;
  const padded = 2 ** Math.ceil(Math.log2(n));
  const re = new Float64Array(padded), im = new Float64Array(padded);
  const mean = samples.reduce((sum, value) => sum + value, 0) / n;
  let weight = 0;
  for (let k = 0; k < n; k++) {
    const w = 0.5 - 0.5 * Math.cos(2 * Math.PI * k / n);
    weight += w;
    re[k] = (samples[k] - mean) * w;
  }
  transform(re, im);
  const hz = new Float64Array(padded / 2), amplitude = new Float64Array(padded / 2);
  for (let k = 0; k < padded / 2; k++) {
    hz[k] = k * rateHz / padded;
    amplitude[k] = 2 * Math.hypot(re[k], im[k]) / weight;
  }
  return { hz, amplitude };
}
