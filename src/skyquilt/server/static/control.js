"use strict";
const handControl = async () => false;
const readControl = async () => {};
