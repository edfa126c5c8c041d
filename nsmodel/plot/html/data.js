// Numbers of the page: unpacked, and columns as pyramids of extremes.

const FAN = 4; // Entries of a level that are one of the next.

/** Bytes of a text in base64. */
function bytesOf(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The numbers that packed.py wrote: words of 32 bits as differences, bytes of one place together. */
async function unpack(block) {
  const bytes = await inflate(bytesOf(block.data));
  const n = block.length;
  if (block.type === "u1") return bytes;
  const planes = block.type === "f8" ? 2 : 1;
  const words = new Uint32Array(planes * n);
  for (let p = 0; p < planes; p++) {
    const at = 4 * p * n;
    let sum = 0;
    for (let i = 0, j = p; i < n; i++, j += planes) {
      sum += bytes[at + i] | (bytes[at + n + i] << 8) | (bytes[at + 2 * n + i] << 16) | (bytes[at + 3 * n + i] << 24);
      words[j] = sum |= 0;
    }
  }
  if (planes === 2) return new Float64Array(words.buffer);
  const single = new Float32Array(words.buffer);
  const values = new Float64Array(n);
  for (let i = 0; i < n; i++) values[i] = block.offset + block.scale * single[i];
  return values;
}

/** Of each FAN entries what `pick` makes of them, NaN left out. */
function coarser(entries, pick) {
  const found = new Float64Array(Math.ceil(entries.length / FAN));
  for (let k = 0; k < found.length; k++) {
    let value = NaN;
    for (let i = k * FAN, end = Math.min(i + FAN, entries.length); i < end; i++) {
      const entry = entries[i];
      if (entry === entry) value = value === value ? pick(value, entry) : entry;
    }
    found[k] = value;
  }
  return found;
}

/** Levels of least (or largest) values; the first is of the entries themselves. */
function pyramid(entries, pick) {
  const levels = [entries];
  while (levels.at(-1).length > 1) levels.push(coarser(levels.at(-1), pick));
  return levels;
}

/** The times of rows: entry k begins at T[k]; T[n] is the last. `width` rows are one entry. */
async function clockOf(data) {
  const T = await unpack(data.times);
  return { T, n: T.length - 1, width: data.width };
}

/** The last entry that begins at t or before. */
function entryAt(clock, t) {
  let low = 0;
  let high = clock.n - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (clock.T[middle] <= t) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** The first of increasing times that is not before t. */
function firstFrom(times, t) {
  let low = 0;
  let high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The first entry that begins after t. */
function firstBeyond(clock, t) {
  return clock.T[0] > t ? 0 : entryAt(clock, t) + 1;
}

/** A column: levels `low` and `high`, of single rows with the values where steps begin in `begin`. */
async function columnOf(data, look, clock) {
  const low = await unpack(data.low);
  const begin = data.begin && (await unpack(data.begin));
  let high = data.high ? await unpack(data.high) : low;
  let least = low;
  if (begin) {
    least = low.map((value, i) => (begin[i] < value ? begin[i] : value));
    high = low.map((value, i) => (begin[i] > value ? begin[i] : value));
  }
  return {
    name: data.name,
    shown: data.shown,
    missing: data.missing,
    clock,
    begin,
    row: low,
    boxes: Boolean(data.high),
    held: look === "step",
    low: pyramid(least, Math.min),
    high: high === low && !begin ? pyramid(low, Math.max) : pyramid(high, Math.max),
  };
}

/** Bits of all entries a <= k < b of a strip. */
function seenOf(levels, a, b) {
  let bits = 0;
  for (let level = 0; a < b; level++) {
    while (a < b && a % FAN) bits |= levels[level][a++];
    while (a < b && b % FAN) bits |= levels[level][--b];
    if (level + 1 === levels.length) {
      while (a < b) bits |= levels[level][a++];
    }
    a /= FAN;
    b /= FAN;
  }
  return bits;
}

async function stripOf(data) {
  const levels = [await unpack(data.seen)];
  while (levels.at(-1).length > 1) {
    const last = levels.at(-1);
    const next = new Uint8Array(Math.ceil(last.length / FAN));
    for (let i = 0; i < last.length; i++) next[(i / FAN) | 0] |= last[i];
    levels.push(next);
  }
  return { name: data.name, kind: data.kind, levels };
}
