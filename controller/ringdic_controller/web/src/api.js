// Requests to the controller. A refusal becomes an Error whose message is the controller's own sentence.

const ROOT = "/api/v1";

export const url = (...parts) => `${ROOT}/${parts.map(encodeURIComponent).join("/")}`;

async function request(address, options) {
  let response;
  try {
    response = await fetch(address, options);
  } catch {
    throw new Error("The controller does not answer.");
  }
  if (response.ok) return response;
  if (response.status === 401) location.assign("/login");
  const answer = await response.json().catch(() => ({}));
  throw new Error(answer.detail ?? `The controller answered ${response.status} ${response.statusText}.`);
}

const withBody = (method) => async (address, body) => {
  const headers = { "Content-Type": "application/json" };
  return (await request(address, { method, headers, body: JSON.stringify(body) })).json();
};

export const post = withBody("POST");
export const put = withBody("PUT");
export const patch = withBody("PATCH");
export const get = async (address) => (await request(address)).json();
export const getText = async (address) => (await request(address)).text();
export const getBytes = async (address) => (await request(address)).arrayBuffer();
