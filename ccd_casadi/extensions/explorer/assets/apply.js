// In the browser alone: sent back they would be heard here as changes. What somebody zoomed stays.
if (message.content == null) return
const [text, numbers] = message.content
const [words, changes] = JSON.parse(text)
for (const [id, html] of Object.entries(words)) {
  const place = document.getElementById(id)
  if (place.said !== html) place.innerHTML = place.said = html
}
const unpacked = value => value?.count == null
  ? Array.isArray(value) ? value.map(unpacked) : value
  : new Float64Array(numbers.buffer, numbers.byteOffset + 8 * value.from, value.count)
for (const [id, values] of changes) {
  const model = message.document.get_model_by_id(id)
  if (model == null || model.have_updated_interactively) continue
  const data = values.data && Object.fromEntries(
    Object.entries(values.data).map(([name, column]) => [name, unpacked(column)]))
  model.setv(data ? {...values, data} : values, {sync: false, check_eq: data == null})
}
