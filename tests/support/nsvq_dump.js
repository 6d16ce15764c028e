// node nsvq_dump.js READER FILE...: the attributes of each file as float32, one after another; errors go to stderr.
const fs = require("fs");
const { decode } = require(process.argv[2]);

for (const path of process.argv.slice(3)) {
  try {
    const scene = decode(fs.readFileSync(path));
    for (const name of ["means", "quats", "scales", "opacities", "sh0", "shN"]) {
      const { buffer, byteOffset, byteLength } = scene[name];
      fs.writeSync(1, Buffer.from(buffer, byteOffset, byteLength));
    }
  } catch (error) {
    process.stderr.write(`${error.message}\n`);
    process.exitCode = 1;
  }
}
