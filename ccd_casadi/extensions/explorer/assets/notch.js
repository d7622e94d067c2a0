// Grabbed near its handle a notch follows the pointer: along the axis, and down from |L|.
const share = (value, at, {start, end}) => Math.abs(Math.log(value / at) / Math.log(end / start))
const {x, y} = handle.data, to = (value, {start, end}) => Math.min(end, Math.max(start, value))
if (cb_obj.event_name === "panstart")
  window.held = x.length > 0 && share(cb_obj.x, x[0], figure.x_range) < 0.06
    && share(cb_obj.y, y[0], figure.y_range) < 0.08
if (!window.held) return
const {xs, ys} = own.data, i = [...xs[0]].findIndex(value => value >= cb_obj.x)
const size = Math.max(...ys.map(row => row[i < 0 ? row.length - 1 : i]))
hz.value = to(Math.log10(cb_obj.x), hz)
depth.value = to(Math.log10(cb_obj.y / size), depth)
if (cb_obj.event_name === "panend") window.held = false
