// Shapes in files: JSON, NumPy, FITS. What a file says of its numbers is kept; what it does not is asked for.

const UNITS = { meter: "m", micron: "um", nanometer: "nm", m: "m", um: "um", nm: "nm" };
const SAID = ["kind", "unit", "basis_id", "config_id"];

// {values, and kind, unit, basis_id, config_id where the file has them}; an error says what was found.
export function shapeOf(name, buffer) {
  const read = /\.json$/i.test(name) ? ofJson : /\.npy$/i.test(name) ? ofNumpy : /\.fits?$/i.test(name) ? ofFits : null;
  if (!read) throw new Error("found another kind of file, expected .json, .npy or .fits (pyrcal references load reads HDF5, too)");
  const { values, shape = [values.length], ...said } = read(buffer);
  const odd = values.filter((value) => !Number.isFinite(value)).length;
  if (odd) throw new Error(`found ${odd} values that are not finite, expected none`);
  if (!values.length) throw new Error("found no numbers");
  const long = shape.filter((n) => n > 1);
  if (long.length === 2 && long[0] === long[1]) said.kind ??= "map";
  return { ...said, values };
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
