// Keeps the page up to date. Without this script the page works by forms and links alone.
"use strict";

const main = document.querySelector("main[data-version]");
let version = main.dataset.version;
let loading = false;
let again = false;

// A section with something typed or chosen in it is never replaced, nor one for which a file is being chosen.
function markAsUsed(event) {
  const section = event.target.closest("[data-live]");
  if (section && (event.type === "input" || event.target.matches("input[type=file]"))) section.dataset.typed = "yes";
}
document.addEventListener("input", markAsUsed);
document.addEventListener("click", markAsUsed);

// What matters of a section: not the tokens of its forms, nor what the operator has unfolded.
function shape(section) {
  const copy = section.cloneNode(true);
  copy.querySelectorAll("input[type=hidden]").forEach((one) => one.removeAttribute("value"));
  copy.querySelectorAll("details").forEach((one) => one.removeAttribute("open"));
  return copy.innerHTML;
}

function isInUse(section) {
  const active = document.activeElement;
  const field = active && active.matches("input, select, textarea") && section.contains(active);
  // The reason why a form was not accepted stays until the operator sends the form again.
  return section.dataset.typed === "yes" || field || section.querySelector("[data-focus]") !== null;
}

function replace(old, fresh) {
  if (shape(old) === shape(fresh) || isInUse(old)) return;
  const open = [...old.querySelectorAll("details")].map((details) => details.open);
  const focused = old.contains(document.activeElement) ? document.activeElement : null;
  const place = focused ? [...old.querySelectorAll("a, button, summary, [tabindex]")].indexOf(focused) : -1;
  old.hidden = fresh.hidden;
  old.replaceChildren(...fresh.childNodes);
  old.querySelectorAll("details").forEach((details, k) => { if (open[k]) details.open = true; });
  if (place >= 0) {
    const next = old.querySelectorAll("a, button, summary, [tabindex]")[place] || old.querySelector("h2, p");
    if (next) { if (next.matches("h2, p")) next.tabIndex = -1; next.focus(); }
  }
}

function replaceOpenTrials(page) {
  const list = document.getElementById("open-trials");
  const fresh = new Map([...page.querySelectorAll("#open-trials > section")].map((one) => [one.id, one]));
  for (const old of [...list.children]) {
    if (fresh.has(old.id)) continue;
    if (!isInUse(old)) { old.remove(); continue; }
    if (old.classList.contains("ended")) continue;
    old.classList.add("ended");
    const note = document.createElement("p");
    note.className = "problem";
    note.setAttribute("role", "alert");
    note.textContent = "This trial has ended in the meantime: a result of it is recorded already.";
    old.querySelector("h2").after(note);
  }
  for (const [id, one] of fresh) if (!document.getElementById(id)) list.append(document.adoptNode(one));
}

async function update() {
  if (loading) { again = true; return; }
  loading = true;
  try {
    const answer = await fetch(`/${location.search.includes("all") ? "?all" : ""}`, { headers: { Accept: "text/html" } });
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    const fresh = page.querySelector("main[data-version]");
    if (!fresh) { say("The session has ended. Load the page again."); return; }
    replaceOpenTrials(page);
    for (const part of page.querySelectorAll("[data-live]")) {
      const old = document.getElementById(part.id);
      if (old && old !== part) replace(old, part);
    }
    for (const name of ["seen", "token"]) {
      const value = page.querySelector(`input[name=${name}]`);
      if (value) document.querySelectorAll(`input[name=${name}]`).forEach((one) => { one.value = value.value; });
    }
    const news = page.getElementById("news").textContent;
    if (document.getElementById("news").textContent !== news) document.getElementById("news").textContent = news;
    version = fresh.dataset.version;
  } finally {
    loading = false;
    if (again) { again = false; update(); }
  }
}

function say(sentence) {
  document.getElementById("connection").textContent = sentence;
}

// The server counts the work; between two of its messages, only the seconds go on.
let work = {};

function showWork() {
  for (const place of document.querySelectorAll("[data-stage]")) {
    const name = place.dataset.stage;
    work[name] = work[name] || { text: place.dataset.text, seconds: Number(place.dataset.seconds), at: Date.now() };
    const { text, done, expected, seconds, at } = work[name];
    const passed = seconds + Math.floor((Date.now() - at) / 1000);
    place.textContent = `${text}, ${passed} s`;
    const bar = place.parentElement.querySelector("progress");
    if (expected) { bar.max = expected; bar.value = done; } else bar.removeAttribute("value");
  }
}

function listen() {
  const source = new EventSource("/events");
  source.addEventListener("open", () => say(""));
  source.addEventListener("error", () => say(source.readyState === EventSource.CLOSED
    ? "The session has ended. Load the page again."
    : "There is no connection to the server. The page shows what it knew last."));
  source.addEventListener("version", (event) => { work = {}; if (event.data !== version) update(); });
  source.addEventListener("work", (event) => {
    work = JSON.parse(event.data);
    for (const one of Object.values(work)) one.at = Date.now();
    showWork();
  });
  setInterval(showWork, 1000);
}

// A file that is too large is refused before it is sent, and a form is sent once.
document.addEventListener("submit", (event) => {
  const form = event.target;
  const file = form.querySelector("input[type=file]");
  if (file && file.files[0] && file.files[0].size > Number(main.dataset.most)) {
    event.preventDefault();
    problem(form, `The file is too large: at most ${Number(main.dataset.most) / 2 ** 20} MiB are accepted.`);
    return;
  }
  if (form.dataset.sent) { event.preventDefault(); return; }
  form.dataset.sent = "yes";
  form.querySelectorAll("button").forEach((button) => button.setAttribute("aria-disabled", "true"));
});

// A page from the history of the browser may be sent again.
window.addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });

function problem(form, sentence) {
  let place = form.querySelector(".problem");
  if (!place) {
    place = document.createElement("p");
    place.className = "problem";
    place.setAttribute("role", "alert");
    form.querySelector("legend").after(place);
  }
  place.textContent = sentence;
}

// After the load, because a browser that goes to the fragment of an address takes the focus away.
window.addEventListener("load", () => {
  const refused = document.querySelector("[data-focus]");
  if (refused) setTimeout(() => refused.focus());
});
// The address of a page with a result must not show the result again after a reload.
if (location.search.includes("told=")) history.replaceState(null, "", "/");
listen();
