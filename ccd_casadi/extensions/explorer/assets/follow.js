// After a reset an axis follows the designs again, which it does not once it was zoomed or moved.
for (const range of [cb_obj.origin.x_range, cb_obj.origin.y_range])
  range.have_updated_interactively = false
