// Typesets units and signs like fdhil/report/typography.py (a test compares the two): µm, ±, °C and N·m.

const PRINTED = {
  "N.m.s/rad": "N·m·s/rad", "N.m/A": "N·m/A", "N.m.s": "N·m·s", "mN.m.s": "mN·m·s", "N.m": "N·m", "kg.m2": "kg·m²", "g.m2": "g·m²",
  "mm/s2": "mm/s²", "mohm": "mΩ", "ohm": "Ω", "degC": "°C", "um": "µm", "+-": "±", "->": "→",
};
const longestFirst = Object.keys(PRINTED).sort((a, b) => b.length - a.length);
const escaped = longestFirst.map((unit) => unit.replace(/[.*+?^${}()|[\]\\/]/g, "\\$&")).join("|");
const ALONE = new RegExp(`(?<![\\p{L}\\p{N}_./-])(${escaped})(?![\\p{L}\\p{N}_]|[./][\\p{L}\\p{N}_])`, "gu");
const RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const raised = (digits) => digits.replace("-", "⁻").replace(/\d/g, (digit) => RAISED[Number(digit)]);

export function typeset(text) {
  return text.replace(/(?<=\))e(-?\d+)/g, (_, digits) => `·10${raised(digits)}`)
    .replace(ALONE, (unit) => PRINTED[unit]).replace(/(?<=\d) x(?![\w.])/g, " ×");
}
