// Move the slider to the time that was clicked.
const t = cycles.data.since
let k = t.findIndex(one => one >= cb_obj.x)
slider.value = k < 0 ? t.length - 1 : k
