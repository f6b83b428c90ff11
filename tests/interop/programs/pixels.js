/** The pixels that a canvas shows in base 64, RGBA, the lower row first; for use in the task that drew them. */
export async function pixels(gl) {
  const { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
  const bytes = new Uint8Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  const reader = new FileReader();
  const read = new Promise((done) => (reader.onload = done));
  reader.readAsDataURL(new Blob([bytes]));
  await read;
  return reader.result.slice(reader.result.indexOf(',') + 1);
}
