// Shapes in files: JSON, NumPy, FITS. What a file says of its numbers is kept; what it does not is asked for.

const UNITS = { meter: "m", micron: "um", nanometer: "nm", m: "m", um: "um", nm: "nm" };
const NUMBERED = { noll: ["zernike", 1], mode: ["modes", 0] }; // column of numbers: kind, first number
const TABLE_TYPES = { B: ["u", 1], I: ["i", 2], J: ["i", 4], K: ["i", 8], E: ["f", 4], D: ["f", 8] };
const OBSCURED = 0.35; // of the pupil's radius; no central obscuration is larger
const SAID = ["kind", "unit", "basis_id", "config_id"];

// {values, and kind, unit, basis_id, config_id where the file has them}; an error says what was found.
export function shapeOf(name, buffer) {
  const read = /\.json$/i.test(name) ? ofJson : /\.npy$/i.test(name) ? ofNumpy : /\.fits?$/i.test(name) ? ofFits : null;
  if (!read) throw new Error("found another kind of file, expected .json, .npy or .fits (pyrcal references load reads HDF5, too)");
  const { values, shape = [values.length], ...said } = read(buffer);
  const long = shape.filter((n) => n > 1);
  if (long.length === 2 && long[0] === long[1]) said.kind ??= "map";
  if (said.kind === "map") fillDark(values);
  const odd = values.filter((value) => !Number.isFinite(value)).length;
  if (odd) throw new Error(`found ${odd} values that are not finite, expected none`);
  if (!values.length) throw new Error("found no numbers");
  return { ...said, values };
}

// The nearest values of a map in place of NaN where no light falls: beyond the pupil and in its middle.
function fillDark(values) {
  const n = Math.sqrt(values.length);
  const place = (k) => ((k + 0.5) * 2) / n - 1;
  const known = values.map((value, k) => [value, k]).filter(([value]) => !Number.isNaN(value));
  values.forEach((value, k) => {
    const [x, y] = [k % n, Math.floor(k / n)];
    const radius = Math.hypot(place(x), place(y));
    if (!Number.isNaN(value) || (radius <= 1 - 2 / n && radius >= OBSCURED)) return;
    let best = Infinity;
    for (const [given, at] of known) {
      const far = ((at % n) - x) ** 2 + (Math.floor(at / n) - y) ** 2;
      if (far < best) [best, values[k]] = [far, given];
    }
  });
}

// In the unit of the values; piston does not count.
export function rmsOf(kind, values) {
  const mean = kind === "map" ? values.reduce((sum, value) => sum + value, 0) / values.length : 0;
  const squares = (kind === "zernike" ? values.slice(1) : values).reduce((sum, value) => sum + (value - mean) ** 2, 0);
  return Math.sqrt(kind === "map" ? squares / values.length : squares);
}

function ofJson(buffer) {
  const found = JSON.parse(new TextDecoder().decode(buffer));
  const values = Array.isArray(found) ? found : found?.values;
  if (!Array.isArray(values) || values.flat().some((value) => typeof value !== "number")) throw new Error("expected a list of numbers, values");
  return { values: values.flat(), ...Object.fromEntries(SAID.filter((key) => found[key]).map((key) => [key, found[key]])) };
}

function ofNumpy(buffer) {
  const bytes = new DataView(buffer);
  if (new TextDecoder("latin1").decode(buffer.slice(1, 6)) !== "NUMPY") throw new Error("found no NumPy file");
  const wide = bytes.getUint8(6) > 1;
  const start = (wide ? 12 : 10) + (wide ? bytes.getUint32(8, true) : bytes.getUint16(8, true));
  const head = new TextDecoder("latin1").decode(buffer.slice(10, start));
  const [, order, type, size] = head.match(/'descr': *'([<>|=])([fiu])(\d)'/) ?? [];
  if (!type || /'fortran_order': *True/.test(head)) throw new Error(`found ${head.slice(0, 60)}, expected an array of numbers in C order`);
  const shape = [...head.match(/'shape': *\(([^)]*)\)/)[1].matchAll(/\d+/g)].map(([n]) => Number(n));
  return { values: numbers(bytes, start, type, Number(size), order !== ">", shape.reduce((a, b) => a * b, 1)), shape };
}

// The shape in a table: one column of coefficients, and one of their numbers or none.
function ofTable(bytes, at, cards) {
  const columns = [];
  for (let k = 1, offset = 0; k <= Number(cards.TFIELDS); k++) {
    const [, repeat, letter] = cards[`TFORM${k}`].match(/^(\d*)([A-Z])/) ?? [];
    const [type, size] = TABLE_TYPES[letter] ?? [];
    if (!type || Number(repeat || 1) !== 1) throw new Error(`found a column ${cards[`TTYPE${k}`]} of ${cards[`TFORM${k}`]}, expected one number in each row`);
    const read = (row) => numbers(bytes, at + row * Number(cards.NAXIS1) + offset, type, size, false, 1)[0];
    const said = [Number(cards[`TSCAL${k}`] ?? 1), Number(cards[`TZERO${k}`] ?? 0)];
    const values = Array.from({ length: Number(cards.NAXIS2) }, (_, row) => said[0] * read(row) + said[1]);
    columns.push({ name: (cards[`TTYPE${k}`] ?? "").toLowerCase(), unit: UNITS[(cards[`TUNIT${k}`] ?? "").toLowerCase()], values });
    offset += size;
  }
  const [places, others] = [columns.filter(({ name }) => NUMBERED[name]), columns.filter(({ name }) => !NUMBERED[name])];
  if (places.length > 1 || others.length !== 1) throw new Error(`found the columns ${columns.map(({ name }) => name).join(", ")}, expected one of coefficients and at most one of their numbers, noll (from 1 on) or mode (from 0 on)`);
  const [{ values, unit }] = others;
  const said = { ...(unit && { unit }) };
  if (!places.length) return { values, ...said };
  const [{ name, values: found }] = places;
  const [kind, first] = NUMBERED[name];
  if (new Set(found).size < found.length || !found.every((n) => Number.isInteger(n) && n >= first && n <= 65_535)) throw new Error(`found a ${name} twice or beyond ${first} to 65535`);
  const shape = new Array(Math.max(first, ...found) - first + 1).fill(0);
  found.forEach((n, k) => (shape[n - first] = values[k]));
  return { values: shape, kind, ...said };
}

// The first HDU with numbers.
function ofFits(buffer) {
  const [bytes, text] = [new DataView(buffer), new TextDecoder("latin1")];
  for (let at = 0; at + 2880 <= buffer.byteLength;) {
    const cards = {};
    for (let ended = false; !ended; at += 2880) {
      if (at + 2880 > buffer.byteLength) throw new Error("found a header without an end");
      const block = text.decode(buffer.slice(at, at + 2880));
      for (const card of block.match(/.{80}/gs)) {
        ended ||= card.startsWith("END  ");
        const [, key, value] = card.match(/^([A-Z0-9_-]+) *= *('[^']*'|[^/]*)/) ?? [];
        if (key && !ended) cards[key] ??= value.replace(/^'|'$/g, "").trim();
      }
    }
    const shape = Array.from({ length: Number(cards.NAXIS ?? 0) }, (_, k) => Number(cards[`NAXIS${k + 1}`]));
    const n = shape.length ? shape.reduce((a, b) => a * b, 1) : 0;
    const bits = Number(cards.BITPIX);
    if (n && cards.XTENSION === "BINTABLE") return ofTable(bytes, at, cards);
    if (n) {
      const raw = numbers(bytes, at, bits < 0 ? "f" : bits === 8 ? "u" : "i", Math.abs(bits) / 8, false, n);
      const [scale, zero] = [Number(cards.BSCALE ?? 1), Number(cards.BZERO ?? 0)];
      const unit = UNITS[(cards.BUNIT ?? cards.UNIT ?? "").toLowerCase()];
      return { values: raw.map((value) => scale * value + zero), shape, ...(cards.KIND && { kind: cards.KIND }), ...(unit && { unit }) };
    }
    at += Math.ceil((n * Math.abs(bits || 8)) / 8 / 2880) * 2880;
  }
  throw new Error("found no array in the FITS file");
}

function numbers(bytes, start, type, size, little, n) {
  const name = { f: "Float", i: "Int", u: "Uint" }[type] + 8 * size;
  const get = { Float32: "getFloat32", Float64: "getFloat64", Int8: "getInt8", Uint8: "getUint8", Int16: "getInt16", Uint16: "getUint16", Int32: "getInt32", Uint32: "getUint32", Int64: "getBigInt64", Uint64: "getBigUint64" }[name];
  if (!get) throw new Error(`found numbers of type ${name}, expected integers or floats of 32 or 64 bits`);
  if (start + n * size > bytes.byteLength) throw new Error(`found fewer than the ${n} numbers that its header says`);
  return Array.from({ length: n }, (_, k) => Number(bytes[get](start + k * size, little)));
}
