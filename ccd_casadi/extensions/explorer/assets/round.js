// At any width of the page both axes have one scale, so that a circle is round: ±`half` fits in.
const {inner_width: wide, inner_height: tall, x_range, y_range} = figure
if (!(wide > 0 && tall > 0)) return
const scale = Math.max(2 * half[0] / wide, 2 * half[1] / tall)
for (const [range, middle, size] of [[x_range, centre, wide], [y_range, 0, tall]]) {
  const start = middle - scale * size / 2, end = middle + scale * size / 2
  range.setv({start, end, reset_start: start, reset_end: end}, {sync: false})
}
