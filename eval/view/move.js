// Place the vehicle at the slider's cycle.
const c = cycles.data, k = slider.value, cos = Math.cos(c.theta[k]), sin = Math.sin(c.theta[k])
vehicle.data = {
    x: ahead.map((a, i) => c.x[k] + cos * a - sin * left[i]),
    y: ahead.map((a, i) => c.y[k] + sin * a + cos * left[i]),
}
const begin = c.since.findIndex(one => one > c.since[k] - trail)
driven.data = {x: c.x.slice(begin, k + 1), y: c.y.slice(begin, k + 1)}
for (const cursor of cursors) { cursor.location = c.since[k] }
const heading = (Math.atan2(sin, cos) * 180 / Math.PI).toFixed(1)
const pose = `x ${c.x[k].toFixed(2)} m, y ${c.y[k].toFixed(2)} m, heading ${heading}°`
const told = [c.health[k], c.reason[k]].filter(Boolean).join(": ")
readout.text = `<b>${c.since[k].toFixed(1)} s</b>, lap ${c.lap[k]}, cycle ${k}: ${pose}<br>`
    + `${c.readings[k]} of ${c.offered[k]} detections used` + (told && `; ${told.replace(/</g, "&lt;")}`)
