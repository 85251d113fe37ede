// Who has logged in; a viewer's page has no buttons that act.

import { get, url } from "./api.js";
import { byId } from "./dom.js";

export async function showAccount() {
  let account;
  try {
    account = await get(url("account"));
  } catch {
    return; // the controller is away, or the login has ended and the page to log in on is on its way
  }
  byId("account").hidden = !account.login;
  byId("account-name").textContent = account.role === "viewer" ? `${account.name} (viewer)` : account.name;
  document.body.classList.toggle("viewer", account.role === "viewer");
}
