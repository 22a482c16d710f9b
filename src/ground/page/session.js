// Who sits at the page. A station on one machine asks nobody; elsewhere a token is shown once, and the
// browser keeps it where no script can read it.

import { $ } from "./dom.js";
import { known } from "./state.js";

const WRONG = "The ground station does not know this token.";
let asking = null; // the promise of the token that is being asked for

export const mayAct = () => known.role === "operator";
export const isAsking = () => asking !== null;

/** Resolves when the station lets this browser read; asks for a token until it does. Rejects without a line. */
export async function enter() {
  if (asking) return asking;
  const answer = await fetch("/session");
  if (answer.ok) { take(await answer.json()); return undefined; }
  if (![401, 403, 429].includes(answer.status)) throw new Error(`the ground station answered ${answer.status}`);
  asking = ask(answer.status === 401 ? "" : await reason(answer)).finally(() => { asking = null; });
  return asking;
}

/** Somebody else than before: what is drawn was for them. */
function take({ role, name, signed_in: signedIn }) {
  if (known.role !== null && known.role !== role) location.reload();
  known.role = role;
  document.body.dataset.role = role;
  $("me").hidden = !mayAct();
  $("sign-out").hidden = !signedIn;
  $("sign-out").title = name ? `Signed in as ${name}` : "";
}

const reason = async (answer) => (await answer.json().catch(() => ({}))).error ?? `The ground station answered ${answer.status}.`;

function ask(why) {
  const dialog = $("sign-in");
  tell(why);
  if (!dialog.open) dialog.showModal();
  return new Promise((resolve) => {
    const submit = async (event) => {
      event.preventDefault();
      if (!await isTaken($("token").value.trim())) return;
      dialog.removeEventListener("submit", submit);
      dialog.close();
      resolve();
    };
    dialog.addEventListener("submit", submit);
  });
}

async function isTaken(token) {
  if (!token) { tell("Type or paste the token that you were given."); return false; }
  $("enter").disabled = true;
  try {
    const answer = await fetch("/session", {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ token }),
    });
    if (answer.ok) { $("token").value = ""; take(await answer.json()); return true; }
    tell(answer.status === 401 ? WRONG : await reason(answer));
    $("token").select();
  } catch {
    tell("No connection to the ground station. Try again.");
  } finally {
    $("enter").disabled = false;
  }
  return false;
}

function tell(why) {
  $("sign-in-wrong").textContent = why;
  $("sign-in-wrong").hidden = !why;
  $("token").setAttribute("aria-invalid", String(Boolean(why)));
}

export function listen() {
  // There is nothing behind it to go back to.
  $("sign-in").addEventListener("cancel", (event) => event.preventDefault());
  $("sign-out").addEventListener("click", async () => {
    await fetch("/session", { method: "DELETE" }).catch(() => {});
    location.reload();
  });
}
