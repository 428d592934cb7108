// Files to one upload: a zip archive whose files are stored as they are, for the service to unpack.

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});

function crc32(bytes) {
  let crc = ~0;
  for (const byte of bytes) crc = TABLE[(crc ^ byte) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

// Little-endian numbers of two ("2") or four ("4") bytes each.
function packed(sizes, numbers) {
  const view = new DataView(new ArrayBuffer([...sizes].reduce((sum, size) => sum + Number(size), 0)));
  let at = 0;
  [...sizes].forEach((size, k) => {
    if (size === "2") view.setUint16(at, numbers[k], true);
    else view.setUint32(at, numbers[k], true);
    at += Number(size);
  });
  return new Uint8Array(view.buffer);
}

const UTF8 = 0x0800; // how names are written
const DATE = 0x21; // 1980-01-01, the first there is

// One file alone as it is; several as a zip archive.
export async function parcelOf(files) {
  if (files.length === 1) return files[0];
  const [parts, directory] = [[], []];
  let offset = 0;
  for (const file of files) {
    const [name, content] = [new TextEncoder().encode(file.name), new Uint8Array(await file.arrayBuffer())];
    const said = [UTF8, 0, 0, DATE, crc32(content), content.length, content.length, name.length, 0];
    const head = packed("42222244422", [0x04034b50, 20, ...said]);
    directory.push(packed("42222224442222244", [0x02014b50, 20, 20, ...said, 0, 0, 0, 0, offset]), name);
    parts.push(head, name, content);
    offset += head.length + name.length + content.length;
  }
  const length = directory.reduce((sum, part) => sum + part.length, 0);
  const end = packed("42222442", [0x06054b50, 0, 0, files.length, files.length, length, offset, 0]);
  return new Blob([...parts, ...directory, end]);
}
