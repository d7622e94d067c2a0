// Names for what reads a page out: figures are canvases, sliders tell the number of their place.
const walk = view => [view, ...(view.child_views ?? []).flatMap(walk)]
const views = Object.values(Bokeh.index).flatMap(walk)
for (const view of views) {
  const {name, title} = view.model
  if (names[name] != null) {
    view.el.setAttribute("role", "img")
    view.el.setAttribute("aria-label", names[name])
  }
  view.shadow_el?.querySelector("input[type=checkbox]")?.setAttribute("aria-label", view.model.label)
  const handles = view.shadow_el?.querySelectorAll(".noUi-handle") ?? []
  const told = () => handles.forEach((handle, i) => {
    const said = view.shadow_el.querySelector(".bk-slider-title")?.textContent ?? ""
    const words = said.slice(said.lastIndexOf(": ") + 2).split(" .. ")[i]
    handle.setAttribute("aria-label", handles.length > 1 ? `${title}, ${i ? "upper" : "lower"}` : title)
    if (words) handle.setAttribute("aria-valuetext", words)
  })
  if (handles.length) {
    told()
    view.model.properties.value.change.connect(() => setTimeout(told, 50))
  }
}
